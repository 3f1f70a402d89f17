"""Every code block of docs/python-api.md runs, with settings of toy size.

docs/test_commands.py reads them in every run.
"""

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shaken import MOTORS, shaken
from toy_settings import run_block, work_in

from cartpole_rl.evaluation.recordings import write_recording

PAGE = Path(__file__).parents[2] / "docs" / "python-api.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S)


def test_the_page_has_a_block_for_each_function() -> None:
    assert len(BLOCKS) == 13
    for name in re.findall(r"`workflows\.([\w.]+)\.(\w+)\(", PAGE.read_text()):
        assert any(f"from cartpole_rl.workflows.{name[0]} import {name[1]}" in block for block in BLOCKS)


@pytest.mark.usefixtures("same_signals", "without_pictures")
@pytest.mark.nightly
def test_every_block_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_plant: Callable, make_environment: Callable
) -> None:
    work_in(tmp_path, monkeypatch)
    env = make_environment(make_plant(6, cart={"track_half_length": 5.0}), MOTORS)
    for number, episode in enumerate(shaken(env)):
        write_recording(tmp_path / f"recordings/{number}.csv", episode, {"pole_length_m": "0.3556"})
    names: dict[str, Any] = {"__name__": "notebook"}
    printed = "".join(run_block(block, PAGE, names) for block in BLOCKS)
    runs = {path.parent.relative_to("runs").as_posix() for path in Path("runs").glob("*/*/provenance.json")}
    commands = {"train", "evaluate", "record", "replay", "model", "identify", "report", "export", "distill"}
    commands |= {"import", "finetune"}
    assert runs == {f"{command}/first" for command in commands} | {"evaluate/on_model"}
    assert len(list(Path("runs/record/first/recordings").glob("*.csv"))) == 2
    comparison = json.loads(Path("runs/finetune/first/comparison.json").read_text())
    assert f"kept: {comparison['kept']}" in printed
    assert "The cart is ready." in printed
    assert "cos_theta" in printed
    with pytest.raises(SystemExit, match=str(128 + signal.SIGTERM)):
        signal.raise_signal(signal.SIGTERM)
