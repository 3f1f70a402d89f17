"""Settings that Python composes from conf/ are those that the commands compose with Hydra."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.config import PreflightConfig, TrainConfig, load_settings


def test_a_file_or_a_mapping_takes_the_place_of_a_choice(tmp_path: Path) -> None:
    randomization = {"posterior": "${here}/posterior.npz", "widen": 2.0, "prior_share": 0.0, "ranges": {}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(randomization))
    config = load_settings(TrainConfig, {"randomization": tmp_path / "own.yaml"})
    assert config.randomization.posterior == tmp_path / "posterior.npz"
    assert load_settings(TrainConfig, {"randomization": {}}) == load_settings(
        TrainConfig, {"randomization": "none"}
    )


def test_a_file_extends_choices_of_its_group(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("defaults: [serial]\nport: COM3\ntimeout: 2.0\n")
    config = load_settings(PreflightConfig, {"plant": tmp_path / "mine.yaml"})
    assert config == load_settings(
        PreflightConfig, {"plant": "serial", "plant.port": "COM3", "plant.timeout": 2.0}
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kind: [serial\n", r"plant=.*mine\.yaml is not valid YAML, line 2: expected ',' or ']'"),
        ("just words\n", r"plant=.*mine\.yaml holds no settings"),
        ("\x01", r"plant=.*mine\.yaml is not valid YAML: unacceptable character"),
        ("defaults: [{override /task: balance}]\n", r"plant=.*mine\.yaml: defaults is a list of choices"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_settings(PreflightConfig, {"plant": tmp_path / "mine.yaml"})
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"pole": "short"}, "pole=short: there is no such choice; there are both"),
        ({"pole": "nowhere.yaml"}, "pole=nowhere.yaml: there is no such file"),
        ({"learning.transitons": 3}, "did you mean learning.transitions"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_errors_name_the_wrong_setting(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_settings(TrainConfig, overrides)
