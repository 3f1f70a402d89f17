"""Every code block of docs/python-api.md runs, with settings of toy size.

docs/test_commands.py reads them in every run.
"""

import contextlib
import io
import json
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from toy_settings import TOY

from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.evaluation.recordings import write_recording
from cartpole_rl.settings import Settings
from cartpole_rl.workflows import config as configs

PAGE = Path(__file__).parents[2] / "docs" / "python-api.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
MOTORS = (-250, -150, 0, 150, 250)
STILL = 30  # periods


@pytest.fixture
def notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory in which settings are of toy size."""
    load = configs.load_settings

    def load_toy(schema: type[Settings], overrides: Mapping[str, Any]) -> Settings:
        return load(schema, {**overrides, **TOY.get(schema, {})})

    monkeypatch.setattr(configs, "load_settings", load_toy)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def record_shaken_carts(folder: Path, make_plant: Callable, make_environment: Callable) -> None:
    """Write six recordings of up to 10 s: the cart stands still, then each motor value is held for 0.2 s."""
    random = torch.Generator().manual_seed(0)
    actions = torch.randint(len(MOTORS), (50, 6), generator=random).repeat_interleave(10, 0)
    actions[:STILL] = MOTORS.index(0)
    in_turn = iter(actions)
    env = make_environment(make_plant(6, cart={"track_half_length": 5.0}), MOTORS)
    episodes = run_batch(env, lambda present: present.set("action", next(in_turn)))
    for number, episode in enumerate(episodes):
        write_recording(folder / f"{number}.csv", episode, {"pole_length_m": "0.3556"})


def test_the_page_has_a_block_for_each_function() -> None:
    assert len(BLOCKS) == 13
    for name in re.findall(r"`workflows\.([\w.]+)\.(\w+)\(", PAGE.read_text()):
        assert any(f"from cartpole_rl.workflows.{name[0]} import {name[1]}" in block for block in BLOCKS)


@pytest.fixture
def signal_handlers() -> Iterator[None]:
    """Put the handlers of signals back afterwards."""
    numbers = signal.SIGTERM, signal.SIGHUP
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.usefixtures("signal_handlers", "without_pictures")
@pytest.mark.nightly
def test_every_block_runs(notebook: Path, make_plant: Callable, make_environment: Callable) -> None:
    record_shaken_carts(notebook / "recordings", make_plant, make_environment)
    names: dict[str, Any] = {"__name__": "notebook"}
    printed = []
    for block in BLOCKS:
        with contextlib.redirect_stdout(io.StringIO()) as output:
            exec(compile(block, PAGE.name, "exec"), names)
        printed.append(output.getvalue())
    runs = {path.parent.relative_to("runs").as_posix() for path in Path("runs").glob("*/*/provenance.json")}
    commands = {"train", "evaluate", "record", "replay", "model", "identify", "report", "export", "distill"}
    commands |= {"import", "finetune"}
    assert runs == {f"{command}/first" for command in commands} | {"evaluate/on_model"}
    assert len(list(Path("runs/record/first/recordings").glob("*.csv"))) == 2
    comparison = json.loads(Path("runs/finetune/first/comparison.json").read_text())
    assert f"kept: {comparison['kept']}" in "".join(printed)
    assert "The cart is ready." in "".join(printed)
    assert "cos_theta" in "".join(printed)
    with pytest.raises(SystemExit, match=str(128 + signal.SIGTERM)):
        signal.raise_signal(signal.SIGTERM)
