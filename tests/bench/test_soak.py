"""The soak test of scripts/fuzz: few episodes of it, and that it would see a motor that is left on."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts/fuzz/soak.py"


@pytest.fixture(scope="module")
def soak() -> ModuleType:
    spec = importlib.util.spec_from_file_location("soak", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_episode_ends_with_a_reason_and_the_motor_at_0() -> None:
    done = subprocess.run(
        [sys.executable, SCRIPT, "--episodes", "1", "--seed", "5"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "over 60 ms: 0" in done.stdout


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
        ([{"us": 100, "took": "HOME"}, {"us": 200, "in_force": 120}, {"us": 300, "in_force": 0}], []),
    ],
)
def test_a_journal_tells_how_long_the_motor_was_on(
    soak: ModuleType, tmp_path: Path, events: list[dict], times: list[float]
) -> None:
    journal = tmp_path / "journal.jsonl"
    journal.write_text("".join(json.dumps(event) + "\n" for event in events))
    assert soak.stop_times(journal) == times
