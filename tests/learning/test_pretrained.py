"""Pretrained agents are small files in the package that load like any run."""

import json
from pathlib import Path

import pytest
from command_line import COARSE, in_process

import cartpole_rl
from cartpole_rl.learning.checkpoints import load_agent
from cartpole_rl.run_folder import find_agent

FOLDER = Path(cartpole_rl.__file__).parent / "pretrained"
AGENTS = sorted(path.name for path in FOLDER.iterdir())


@pytest.mark.parametrize("name", AGENTS)
def test_a_pretrained_agent_is_small_and_says_how_it_was_made(name: str) -> None:
    assert sum(path.stat().st_size for path in (FOLDER / name).iterdir()) < 300_000
    agent = load_agent(Path("pretrained", name))
    origin = json.loads((FOLDER / name / "provenance.json").read_text())
    assert origin["command"][0] == "cartpole-train"
    assert origin["score"] == agent.score
    assert origin["seed"] == agent.config["seed"]


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mine = Path("pretrained/medium/checkpoints/last.pt")
    mine.parent.mkdir(parents=True)
    mine.touch()
    assert find_agent(Path("pretrained/medium")) == mine


@pytest.mark.usefixtures("without_pictures")
def test_a_pretrained_agent_drives_an_emulated_cart(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason='mujoco is missing: pip install "cartpole_rl[emulator]"')
    words = ("run=pretrained/medium", "plant=emulated", COARSE, "episodes=1", "hydra.run.dir=run")
    done = in_process("evaluate", *words, folder=tmp_path)
    assert done.code == 0, done.err
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["episodes"][0]["score"] > 4000
    assert metrics["ended_by"] == {"time": 1}
