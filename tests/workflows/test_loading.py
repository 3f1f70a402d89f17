"""Settings that Python composes from conf/ are those that the commands compose with Hydra."""

from pathlib import Path
from typing import Any

import hydra
import pytest
import yaml

from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.commands.hydra_application.composition import as_mapping
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.workflows.config import EvaluateConfig, PreflightConfig, TrainConfig
from cartpole_rl.workflows.loading import COMMANDS, load_settings

pytestmark = pytest.mark.usefixtures("hydra_reads_conf")

REQUIRED = {
    "evaluate": {"run": "lqr"},
    "record": {"run": "lqr"},
    "replay": {"from": "."},
    "distill": {"run": "."},
    "model": {"from": "."},
    "report": {"runs": "."},
    "export": {"run": "pretrained/medium", "format": "web"},
}
EXPERIMENTS = sorted(path.stem for path in (conf_folder() / "experiment").glob("*.yaml"))


def of_hydra(schema: type[Settings], overrides: dict[str, Any]) -> Settings:
    """Return the settings that Hydra composes for `schema` with these overrides."""
    words = [f"{name}={value}" for name, value in overrides.items()]
    return checked(schema, as_mapping(hydra.compose(COMMANDS[schema], words)))


@pytest.mark.parametrize("schema", COMMANDS)
def test_defaults_are_those_of_the_command(schema: type[Settings]) -> None:
    overrides = REQUIRED.get(COMMANDS[schema], {})
    if schema is PreflightConfig:
        overrides = {"plant.port": "auto"}
    assert load_settings(schema, overrides) == of_hydra(schema, overrides)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiments_are_those_of_the_command(experiment: str) -> None:
    overrides = {"experiment": experiment, "seed": 3}
    assert load_settings(TrainConfig, overrides) == of_hydra(TrainConfig, overrides)


@pytest.mark.parametrize(
    "overrides",
    [
        {"pole": "both", "randomization": "none", "learning.carts": 64},
        {"experiment": "large", "pole": "medium", "task": "balance", "cart.cart_mass": 0.6},
        {"agent": "recurrent", "observation": "positions", "task.x_max": 0.2},
    ],
)
def test_choices_and_values_are_those_of_the_command(overrides: dict[str, Any]) -> None:
    assert load_settings(TrainConfig, overrides) == of_hydra(TrainConfig, overrides)


def test_an_evaluation_of_a_task_uses_the_agents_track() -> None:
    overrides = {"run": "lqr", "task": "balance", "plant": "emulated", "emulator": "large"}
    assert load_settings(EvaluateConfig, overrides) == of_hydra(EvaluateConfig, overrides)


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
        ({"pole": "short"}, "no choice 'pole/short'"),
        ({"pole": "nowhere.yaml"}, "pole=nowhere.yaml: there is no such file"),
        ({"learning.transitons": 3}, "did you mean learning.transitions"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_errors_name_the_wrong_setting(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_settings(TrainConfig, overrides)
