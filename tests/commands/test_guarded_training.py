"""The share of periods under the track guard, from training to the printed scores."""

import json
from pathlib import Path

import pytest
from command_line import ONCE, TINY, in_process
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

FRACTION = "guarded_fraction"


def tags(run: Path) -> set[str]:
    """The curves of a run in TensorBoard."""
    (file,) = run.glob("events*")
    return {value.tag for event in EventFileLoader(str(file)).Load() for value in event.summary.value}


@pytest.mark.usefixtures("without_pictures")
def test_every_command_shows_how_often_the_guard_acts(tmp_path: Path) -> None:
    run = tmp_path / "run"
    wide = "task.evaluation_start.position_spread=0.37"  # the guard acts in some of these starts
    done = in_process("train", *TINY, ONCE, "guard=careful", wide, f"hydra.run.dir={run}", folder=tmp_path)
    assert done.code == 0, done.err
    assert "track guard: margin 0.0" in done.err
    assert {f"exploration/{FRACTION}", "evaluation/track_guard_fraction"} <= tags(run)
    history = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    metrics = json.loads((run / "metrics.json").read_text())
    assert history[-1][FRACTION] == metrics[FRACTION]["mean"]

    shown = in_process("evaluate", "run=run", "episodes=20", "hydra.run.dir=shown", folder=tmp_path)
    assert "share of time under the track guard" in shown.out
    assert "track guard: margin 0.0" in shown.out
    metrics = json.loads((tmp_path / "shown" / "metrics.json").read_text())
    shares = [episode[FRACTION] for episode in metrics["episodes"]]
    assert max(shares) > 0

    recorded = in_process("record", "run=run", "episodes=20", "hydra.run.dir=rec", folder=tmp_path)
    assert f"recordings/ holds 20 episodes, guarded {100 * sum(shares) / 20:.1f} %" in recorded.out

    words = ("run=run", "guard=none", "episodes=2", "hydra.run.dir=none")
    unguarded = in_process("evaluate", *words, folder=tmp_path)
    assert "track guard" not in unguarded.out
    assert json.loads((tmp_path / "none" / "metrics.json").read_text())[FRACTION] is None
