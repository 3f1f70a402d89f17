"""Checkpoints are written whole or not at all, and a file that is none is named in one clear line.

Pretrained agents are small files in the package that load like any run.
"""

import errno
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from small_files import files_of_at_most

import cartpole_rl
from cartpole_rl.errors import CheckpointError
from cartpole_rl.learning.checkpoints import (
    AGENT_FORMAT,
    FINETUNING_FORMAT,
    TRAINING_FORMAT,
    AgentCheckpoint,
    TrainingCheckpoint,
    forget_training,
    load_agent,
    load_training,
    save_agent,
    save_training,
)
from cartpole_rl.run_folder import find_agent

AGENT = AgentCheckpoint(config={"seed": 1}, weights={"w": torch.arange(3.0)}, transitions=10, score=2.5)
TRAINING = TrainingCheckpoint(config={"seed": 1}, state={"counters": [1, 2]}, step=10)
LAST, RESUME = Path("checkpoints/last.pt"), Path("checkpoints/resume.pt")


def check_refused(load: Callable[[Path], object], path: Path, words: str) -> None:
    with pytest.raises(CheckpointError) as caught:
        load(path)
    assert str(path) in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_training_comes_back(tmp_path: Path) -> None:
    save_training(tmp_path, TRAINING)
    assert load_training(tmp_path) == TRAINING
    forget_training(tmp_path)
    forget_training(tmp_path)  # once more does no harm
    assert not list((tmp_path / "checkpoints").iterdir())


def test_a_training_is_no_fine_tuning(tmp_path: Path) -> None:
    save_training(tmp_path, TRAINING, FINETUNING_FORMAT)
    assert load_training(tmp_path, FINETUNING_FORMAT) == TRAINING
    with pytest.raises(CheckpointError, match="it is the state that a fine-tuning resumes from"):
        load_training(tmp_path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_neither_written_nor_read(value: float, tmp_path: Path) -> None:
    save_agent(tmp_path / LAST, AGENT)
    whole = (tmp_path / LAST).read_bytes()
    diverged = AgentCheckpoint({}, {"w": torch.tensor([1.0, value])}, transitions=20, score=None)
    with pytest.raises(CheckpointError, match=r"last\.pt is not written: its weight w is not finite"):
        save_agent(tmp_path / LAST, diverged)
    assert (tmp_path / LAST).read_bytes() == whole
    with pytest.raises(CheckpointError, match=r"resume\.pt is not written: its weight w is not finite"):
        save_training(tmp_path, TrainingCheckpoint({}, {"agent": diverged.weights}, step=20))
    torch.save({"format": "cartpole_rl agent 1", **vars(diverged)}, tmp_path / LAST)
    check_refused(load_agent, tmp_path / LAST, "is refused: its weight w is not finite")
    resumed = {"format": TRAINING_FORMAT, "config": {}, "state": {"agent": diverged.weights}, "step": 20}
    torch.save(resumed, tmp_path / RESUME)
    check_refused(load_training, tmp_path, "is refused: its weight w is not finite")


@pytest.mark.parametrize("content", [b"", b"hello, I am a text file\n", b"PK\x03\x04 and no more", 0.1, 0.99])
def test_a_foreign_or_truncated_file_is_named(content: bytes | float, tmp_path: Path) -> None:
    """A number is the share of a checkpoint that is left."""
    save_agent(path := tmp_path / "agent.pt", AGENT)
    whole = path.read_bytes()
    path.write_bytes(content if isinstance(content, bytes) else whole[: int(content * len(whole))])
    check_refused(load_agent, path, "is not a checkpoint of this package, or is damaged")
    check_refused(
        load_agent, path, "give one that cartpole-train wrote; a policy of your own is run=module:name"
    )


def test_a_torch_file_of_another_kind_is_named(tmp_path: Path) -> None:
    for content in ({"state_dict": {}}, torch.zeros(3)):
        torch.save(content, tmp_path / "other.pt")
        check_refused(load_agent, tmp_path / "other.pt", "its format is None")
    torch.save({"format": "cartpole_rl agent 0"}, tmp_path / "other.pt")
    check_refused(load_agent, tmp_path / "other.pt", "use that version, or start anew")
    save_training(tmp_path, TRAINING)
    check_refused(load_agent, tmp_path / RESUME, "not an agent")


@pytest.mark.parametrize(
    ("part", "value", "named"),
    [
        ("config", None, "config: Input should be a valid dictionary"),
        ("config", {1: 2}, "config: Input should be a valid string"),
        ("weights", [1.0], "weights: Input should be a valid dictionary"),
        ("transitions", "10", "transitions: Input should be a valid integer"),
        ("score", "high", "score: Input should be a valid number"),
        ("tuned_poles", [5], "tuned_poles: Input should be a valid dictionary"),
        ("speed", 1, "its parts are config, weights, transitions, score, tuned_poles, speed; give another"),
        ("weights", ..., "its parts are config, transitions, score, tuned_poles; give another one"),
    ],
)
def test_an_agent_with_a_wrong_part_is_named(part: str, value: object, named: str, tmp_path: Path) -> None:
    path, parts = tmp_path / "agent.pt", {"format": AGENT_FORMAT, **vars(AGENT), part: value}
    torch.save({name: each for name, each in parts.items() if each is not ...}, path)
    check_refused(load_agent, path, f"is damaged, or of another version of this package: {named}")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"config": None}, "config: Input should be a valid dictionary"),
        ({"step": 1.5}, "step: Input should be a valid integer"),
        ({"state": {"agent": None}}, "its agent is no dictionary"),
    ],
)
def test_a_training_with_a_wrong_part_is_named(change: dict, named: str, tmp_path: Path) -> None:
    save_training(tmp_path, TRAINING)
    torch.save({"format": TRAINING_FORMAT, **vars(TRAINING), **change}, tmp_path / RESUME)
    check_refused(load_training, tmp_path, named)


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    class Malicious:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "touched",))

    torch.save(Malicious(), tmp_path / "malicious.pt")
    check_refused(load_agent, tmp_path / "malicious.pt", "is not a checkpoint of this package")
    assert not (tmp_path / "touched").exists()


def test_a_file_left_half_written_does_no_harm(tmp_path: Path) -> None:
    save_agent(tmp_path / LAST, AGENT)

    (tmp_path / "checkpoints/last.pt.partial").write_bytes(b"half a check")  # of a process that was killed
    assert load_agent(tmp_path).transitions == 10
    save_agent(tmp_path / LAST, AgentCheckpoint({}, {}, transitions=20, score=None))
    assert load_agent(tmp_path).transitions == 20
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.pt"]


@pytest.mark.parametrize("count", [2_000, 1_000_000])  # the weights are written at once, or in parts
def test_a_checkpoint_that_cannot_be_written_leaves_the_earlier_one(count: int, tmp_path: Path) -> None:
    save_training(tmp_path, TRAINING)
    path = tmp_path / RESUME
    larger = TrainingCheckpoint({}, {"agent": {"w": torch.zeros(count)}}, step=20)
    with files_of_at_most(4096), pytest.raises(OSError, match="File too large") as caught:
        save_training(tmp_path, larger)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert [each.name for each in path.parent.iterdir()] == ["resume.pt"]
    assert load_training(tmp_path) == TRAINING


PRETRAINED = Path(cartpole_rl.__file__).parent / "pretrained"
NAMES = sorted(path.name for path in PRETRAINED.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_a_pretrained_agent_is_small_and_says_how_it_was_made(name: str) -> None:
    assert sum(path.stat().st_size for path in (PRETRAINED / name).iterdir()) < 300_000
    agent = load_agent(Path("pretrained", name))
    origin = json.loads((PRETRAINED / name / "provenance.json").read_text())
    assert origin["command"][0] == "cartpole-train"
    assert origin["score"] == agent.score
    assert origin["seed"] == agent.config["seed"]


def test_a_file_of_the_name_of_a_pretrained_agent_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mine = Path("pretrained/medium/checkpoints/last.pt")
    mine.parent.mkdir(parents=True)
    mine.touch()
    assert find_agent(Path("pretrained/medium")) == mine


def test_a_file_of_python_is_told_how_a_policy_is_given(tmp_path: Path) -> None:
    (tmp_path / "mine.py").touch()
    with pytest.raises(CheckpointError, match="given as run=mine:<its name>"):
        find_agent(tmp_path / "mine.py")
