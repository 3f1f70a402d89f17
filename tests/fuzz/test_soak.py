"""The soak test of scripts/fuzz: a short run of it, and how it reads a journal."""

import json
from pathlib import Path

import pytest
import soak
from bench_scripts import Run

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')


def test_each_episode_ends_with_a_reason_and_the_motor_at_0(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(soak, tmp_path, "--episodes", "1", "--seed", "5")
    assert ended.value.code == 0
    assert "over 60 ms: 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("events", "times"),
    [
        ([{"us": 100, "took": "SET_MOTOR", "motor": 9}, {"us": 150, "in_force": 9}], [float("inf")]),
        (
            [
                {"us": 10_000, "took": "SET_MOTOR", "motor": 9},
                {"us": 11_000, "in_force": 9},
                {"us": 70_000, "took": "SET_MOTOR", "motor": 0},
                {"us": 90_000, "in_force": 0},
                {"us": 91_000, "took": "START"},
                {"us": 92_000, "took": "SET_MOTOR", "motor": -9},
                {"us": 93_000, "in_force": -9},
                {"us": 94_000, "in_force": 0},
            ],
            [80.0, 2.0],
        ),
        (
            [{"us": 10_000, "took": "SET_MOTOR", "motor": 250}]
            + [{"us": us, "in_force": motor} for us, motor in ((11_000, 250), (50_000, -255), (900_000, 0))],
            [40.0],
        ),
        ([{"us": 100, "took": "HOME"}, {"us": 200, "in_force": 120}, {"us": 300, "in_force": 0}], []),
    ],
)
def test_a_journal_tells_how_long_the_motor_was_on(
    tmp_path: Path, events: list[dict], times: list[float]
) -> None:
    journal = tmp_path / "journal.jsonl"
    journal.write_text("".join(json.dumps(event) + "\n" for event in events))
    assert soak.stop_times(journal) == times
