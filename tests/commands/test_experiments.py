"""Every experiment file starts: a training of a few transitions learns, is evaluated and ends."""

import json
from pathlib import Path

import pytest
from command_line import ONCE, TINY, in_process

from cartpole_rl.choices import conf_folder

EXPERIMENTS = sorted(path.stem for path in (conf_folder() / "experiment").glob("*.yaml"))
DAILY = ("balance", "both_blind", "recurrent", "thesis_swingup")  # which differ most
SHORTER = (ONCE, "learning.transitions=512", "task.time_limit=10")


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    "experiment",
    [name if name in DAILY else pytest.param(name, marks=pytest.mark.nightly) for name in EXPERIMENTS],
)
def test_an_experiment_starts(experiment: str, tmp_path: Path) -> None:
    words = (f"experiment={experiment}", *TINY, *SHORTER, "hydra.run.dir=run")
    done = in_process("train", *words, folder=tmp_path)
    assert done.code == 0, done.err
    (line,) = (tmp_path / "run/history.jsonl").read_text().splitlines()
    assert json.loads(line)["transitions"] == 512
    assert json.loads((tmp_path / "run/metrics.json").read_text())["steps"]["mean"] <= 10
