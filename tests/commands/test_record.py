"""cartpole-record on every kind of cart and when it is interrupted, and run=lqr."""

import json
import math
from pathlib import Path

import pytest
import yaml
from command_line import COARSE, in_process, interrupt_after

from cartpole_rl.evaluation.recordings import read_recording


def headings(path: Path) -> set[str]:
    return {line for line in path.read_text().splitlines() if line.startswith("#")}


def test_every_episode_of_an_agent_is_a_file(trained: Path, tmp_path: Path) -> None:
    done = in_process("record", f"run={trained}", "episodes=3", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 0, done.err
    assert "run/recordings/ holds 3 episodes, guarded " in done.out
    assert done.out.splitlines()[-1] == "cartpole-replay from=run"
    paths = sorted((tmp_path / "run/recordings").iterdir())
    assert [path.name for path in paths] == [f"episode_00{number}.csv" for number in range(3)]
    assert all(read_recording(path).episode.steps > 1 for path in paths)
    assert {
        "# plant: simulated",
        "# pole: medium",
        "# pole_length_m: 0.3556",
        "# control_period_s: 0.02",
        f"# run: {trained}",
    } <= headings(paths[0])
    config = yaml.safe_load((tmp_path / "run/config.yaml").read_text())
    assert config["recorded"]["task"]["time_limit"] == 60
    assert (tmp_path / "run/provenance.json").exists()


def test_the_length_of_a_drawn_pole_is_that_of_its_cart(trained: Path, tmp_path: Path) -> None:
    words = (f"run={trained}", "pole=range", "episodes=2", "hydra.run.dir=run")
    assert in_process("record", *words, folder=tmp_path).code == 0
    recordings = [*map(read_recording, sorted((tmp_path / "run/recordings").iterdir()))]
    lengths = [2 * json.loads(each.facts["cart"])["pole_com"] for each in recordings]
    assert [each.pole_length for each in recordings] == pytest.approx(lengths, abs=1e-4)
    assert lengths[0] != lengths[1]


def test_the_baseline_drives_the_emulated_cart_with_its_own_pole(tmp_path: Path) -> None:
    words = ("run=lqr", "plant=emulated", COARSE, "emulator=large", "episodes=1", "hydra.run.dir=run")
    done = in_process("record", *words, folder=tmp_path)
    assert done.code == 0, done.err
    path = tmp_path / "run/recordings/episode_000.csv"
    assert {"# plant: emulated", "# pole_length_m: 0.6560", "# run: lqr"} <= headings(path)
    assert math.remainder(read_recording(path).episode.theta[-1], math.tau) == pytest.approx(0, abs=0.1)


def test_the_baseline_knows_the_nominal_cart_and_not_the_simulated_one(tmp_path: Path) -> None:
    for run, parameters in {"nominal": "null", "other": "{force_linear:0.03}"}.items():
        words = (
            "run=lqr",
            "episodes=1",
            "task=swingup",
            "task.time_limit=10",
            f"parameters={parameters}",
            f"hydra.run.dir={run}",
        )
        assert in_process("record", *words, folder=tmp_path).code == 0
    first = [
        read_recording(tmp_path / run / "recordings/episode_000.csv").episode for run in ("nominal", "other")
    ]
    assert first[0].motor[0] == first[1].motor[0]
    assert abs(first[1].x[3] - first[1].x[0]) > 1.3 * abs(first[0].x[3] - first[0].x[0])


def test_the_baseline_has_one_pole(tmp_path: Path) -> None:
    done = in_process("record", "run=lqr", "pole=both", folder=tmp_path)
    assert done.code == 2
    assert "run=lqr takes one pole" in done.complaint
    assert "choose one, as pole=medium" in done.complaint
    assert not list(tmp_path.glob("runs/record/*"))


def test_an_interrupt_keeps_the_finished_episodes(tmp_path: Path) -> None:
    interrupt_after(tmp_path / "run/recordings/episode_000.csv")
    words = (
        "run=lqr",
        "plant=emulated",
        COARSE,
        "task=swingup",
        "task.time_limit=50",
        "episodes=1000",
        "hydra.run.dir=run",
    )
    done = in_process("record", *words, folder=tmp_path)
    assert done.code == 130
    assert done.err.endswith("cartpole-record: interrupted\n")
    paths = sorted((tmp_path / "run/recordings").glob("*.csv"))
    assert f"holds {len(paths)} episode" in done.out
    assert all(read_recording(path).episode.ended_by == "time" for path in paths)
