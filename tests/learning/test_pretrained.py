"""Pretrained agents are small files in the package that load like any run."""

import json
from pathlib import Path

import pytest

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
