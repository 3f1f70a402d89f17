"""The compiled part of TorchRL, sampling by priority, and a buffer restored to the bit."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from cartpole_rl.choices import choice
from cartpole_rl.learning.settings import BufferSettings
from cartpole_rl.learning.states import buffer_state, make_buffer, restore_buffer

KINDS = ("prioritized", "uniform")


def numbered(count: int) -> TensorDict:
    rows = torch.arange(count)
    return TensorDict({"number": rows, "next": {"observation": rows.repeat(3, 1).T.float()}}, [count])


def buffer(kind: str, batch_size: int, size: int = 64, rows: int = 0) -> TensorDictReplayBuffer:
    """A buffer with `rows` numbered transitions, added 30 at a time."""
    given = {"size": size, "alpha": 0.5, "beta": (1.0, 1.0), "priority_eps": 1e-6}
    made = make_buffer(BufferSettings(**choice(f"buffer/{kind}") | given), batch_size)
    for part in numbered(rows).split(30) if rows else []:
        made.extend(part)
    return made


def seed() -> None:
    """Seed the generators that the samplers draw from."""
    np.random.seed(3)  # noqa: NPY002
    torch.manual_seed(3)


@pytest.mark.parametrize("kind", KINDS)
def test_transitions_are_drawn_by_priority_or_alike(kind: str) -> None:
    """The square root of the priority, with alpha = 0.5; importance weights undo it at beta = 1."""
    seed()
    replay, priority = buffer(kind, 4096, rows=4), torch.tensor([1.0, 4.0, 9.0, 16.0])
    if kind == "prioritized":
        replay.update_priority(torch.arange(4), priority)
    batch, expected = replay.sample(), torch.full((4,), 0.25)
    if kind == "prioritized":
        expected = priority.sqrt() / priority.sqrt().sum()
        weights = 1 / priority.sqrt()[batch["number"]]
        torch.testing.assert_close(batch["priority_weight"], weights, rtol=1e-3, atol=0)
    shares = torch.bincount(batch["number"], minlength=4) / len(batch)
    torch.testing.assert_close(shares, expected, atol=0.03, rtol=0)  # four standard errors
    assert ("priority_weight" in batch.keys()) == (kind == "prioritized")  # noqa: SIM118


def test_the_error_of_the_loss_becomes_the_priority() -> None:
    seed()
    replay = buffer("prioritized", 512, rows=4)
    batch = replay.sample()
    batch["td_error"] = (batch["number"] == 2).float().unsqueeze(-1)
    replay.update_tensordict_priority(batch)
    assert (replay.sample()["number"] == 2).float().mean() > 0.98  # the others keep priority_eps


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [0, 10, 64, 100])
def test_a_restored_buffer_goes_on_to_the_bit(kind: str, rows: int, tmp_path: Path) -> None:
    """Also one that is wrapped round, over one that held other transitions; priorities move all the time."""
    original, restored = buffer(kind, 8, rows=rows), buffer(kind, 8, rows=40)

    def use(replay: TensorDictReplayBuffer) -> list[int]:
        seed()
        seen: list[int] = []
        for _ in range(20 if rows else 0):
            batch = replay.sample()
            seen += batch["number"].tolist()
            batch["td_error"] = batch["number"].float().unsqueeze(-1)
            replay.update_tensordict_priority(batch)
            replay.extend(numbered(3))
        return seen

    use(original)
    torch.save(buffer_state(original), tmp_path / "replay.pt")
    restore_buffer(restored, torch.load(tmp_path / "replay.pt", weights_only=True))
    assert use(restored) == use(original)
    for replay in (original, restored):
        replay.extend(numbered(40))
    assert (restored[:] == original[:]).all()
    assert len(original) == (64 if rows else 40)


def test_a_file_has_the_size_of_what_is_in_the_buffer(tmp_path: Path) -> None:
    sizes = []
    for size in (1000, 100_000):
        torch.save(buffer_state(buffer("prioritized", 8, size, rows=500)), tmp_path / "replay.pt")
        sizes.append((tmp_path / "replay.pt").stat().st_size)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.01)
    assert sizes[0] < 500 * 60  # bytes: what 500 transitions take, and a little more
