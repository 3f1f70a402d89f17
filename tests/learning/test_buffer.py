"""The compiled part of TorchRL, sampling by priority, and n-step transitions against a loop over rows."""

import importlib

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cartpole_rl.learning.buffer import (
    NStepReturns,
    buffer_snapshot,
    make_buffer,
    n_step_transitions,
    restore_buffer,
)
from cartpole_rl.learning.settings import BufferSettings

PRIORITIZED = {"kind": "prioritized", "size": 64, "alpha": 0.5, "beta": (1.0, 1.0), "priority_eps": 1e-6}
UNIFORM = {"kind": "uniform", "size": 64, "alpha": 0.0, "beta": (1.0, 1.0), "priority_eps": 1e-6}


def numbered(count: int) -> TensorDict:
    return TensorDict({"number": torch.arange(count)}, [count])


def test_the_compiled_part_of_torchrl_fits_this_torch() -> None:
    importlib.import_module("torchrl._torchrl")


def test_prioritized_replay_samples_by_priority() -> None:
    np.random.seed(0)  # noqa: NPY002 - what TorchRL's sampler draws from
    replay = make_buffer(BufferSettings(**PRIORITIZED), batch_size=4)
    replay.extend(numbered(4))
    priority = torch.tensor([1.0, 4.0, 9.0, 16.0])
    replay.update_priority(torch.arange(4), priority)
    drawn = torch.cat([replay.sample()["number"] for _ in range(2500)])
    shares = torch.bincount(drawn, minlength=4) / len(drawn)
    expected = priority.sqrt() / priority.sqrt().sum()  # alpha = 0.5
    assert torch.allclose(shares, expected, atol=0.02)  # four standard errors


def test_importance_weights_undo_the_sampling_at_beta_1() -> None:
    replay = make_buffer(BufferSettings(**PRIORITIZED), batch_size=256)
    replay.extend(numbered(4))
    priority = torch.tensor([1.0, 4.0, 9.0, 16.0])
    replay.update_priority(torch.arange(4), priority)
    batch = replay.sample()
    assert torch.allclose(batch["priority_weight"], 1 / priority.sqrt()[batch["number"]], rtol=1e-3)


def test_the_error_of_the_loss_becomes_the_priority() -> None:
    np.random.seed(0)  # noqa: NPY002
    replay = make_buffer(BufferSettings(**PRIORITIZED), batch_size=64)
    replay.extend(numbered(4))
    batch = replay.sample()
    assert set(batch["number"].tolist()) == {0, 1, 2, 3}
    batch["td_error"] = (batch["number"] == 2).float().unsqueeze(-1)
    replay.update_tensordict_priority(batch)
    drawn = torch.cat([replay.sample()["number"] for _ in range(50)])
    assert (drawn == 2).float().mean() > 0.98  # the others keep priority_eps


def test_uniform_replay_samples_uniformly() -> None:
    torch.manual_seed(0)
    replay = make_buffer(BufferSettings(**UNIFORM), batch_size=4)
    replay.extend(numbered(4))
    drawn = torch.cat([replay.sample()["number"] for _ in range(2500)])
    assert torch.allclose(torch.bincount(drawn, minlength=4) / len(drawn), torch.full((4,), 0.25), atol=0.02)
    assert "priority_weight" not in replay.sample().keys()  # noqa: SIM118 - a TensorDict


@pytest.mark.parametrize("settings", [PRIORITIZED, UNIFORM])
def test_the_oldest_are_overwritten(settings: dict) -> None:
    replay = make_buffer(BufferSettings(**settings), batch_size=1024)
    replay.extend(numbered(100))
    assert len(replay) == 64
    assert replay.sample()["number"].min() >= 36


@pytest.mark.parametrize("settings", [PRIORITIZED, UNIFORM])
@pytest.mark.parametrize("filled", [10, 100])
def test_a_restored_buffer_draws_the_same_batches(settings: dict, filled: int, tmp_path) -> None:
    def use(replay) -> list[int]:
        np.random.seed(3)  # noqa: NPY002
        torch.manual_seed(3)
        seen: list[int] = []
        for _ in range(20):
            batch = replay.sample()
            batch["td_error"] = torch.rand(8, 1)
            if settings["kind"] == "prioritized":
                replay.update_tensordict_priority(batch)
            replay.extend(numbered(3))
            seen += batch["number"].tolist()
        return seen

    original = make_buffer(BufferSettings(**settings), batch_size=8)
    original.extend(numbered(filled))
    use(original)
    torch.save(buffer_snapshot(original), tmp_path / "replay.pt")
    restored = make_buffer(BufferSettings(**settings), batch_size=8)
    restore_buffer(restored, torch.load(tmp_path / "replay.pt", weights_only=True))
    assert use(restored) == use(original)


@pytest.mark.parametrize("settings", [PRIORITIZED, UNIFORM])
def test_a_snapshot_holds_the_filled_rows_alone(settings: dict, tmp_path) -> None:
    """A small and a large buffer with the same transitions give files of the same size."""
    sizes = []
    for capacity in (1000, 100_000):
        replay = make_buffer(BufferSettings(**{**settings, "size": capacity}), batch_size=8)
        replay.extend(n_step_transitions(random_chunk(10, 50, seed=0), 3, 0.9))
        torch.save(buffer_snapshot(replay), tmp_path / "replay.pt")
        sizes.append((tmp_path / "replay.pt").stat().st_size)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.01)
    assert sizes[0] < 500 * 100  # bytes: what 500 transitions take, and a little more


@pytest.mark.parametrize("settings", [PRIORITIZED, UNIFORM])
@pytest.mark.parametrize("filled", [0, 30, 64, 90])
def test_a_restored_buffer_holds_the_same_transitions_in_the_same_places(
    settings: dict, filled: int, tmp_path
) -> None:
    """Also one that is wrapped round, and one that had other transitions before."""
    transitions = n_step_transitions(random_chunk(10, 10, seed=1), 3, 0.9)
    original, restored = (make_buffer(BufferSettings(**settings), batch_size=8) for _ in range(2))
    restored.extend(transitions[-40:])
    for first in range(0, filled, 30):
        original.extend(transitions[first : min(first + 30, filled)])
    torch.save(buffer_snapshot(original), tmp_path / "replay.pt")
    restore_buffer(restored, torch.load(tmp_path / "replay.pt", weights_only=True))
    for more in range(2):
        assert len(restored) == len(original) == min(64, filled + 40 * more)
        if len(original):
            assert (restored[:] == original[:]).all()
        for replay in (original, restored):
            replay.extend(transitions[:40])


def random_chunk(carts: int, periods: int, seed: int) -> TensorDict:
    """Transitions [N, T] in which a tenth of the periods terminate and a tenth are truncated."""
    generator = torch.Generator().manual_seed(seed)
    end = torch.rand(carts, periods, 1, generator=generator)
    return TensorDict(
        {
            "observation": torch.randn(carts, periods, 2, generator=generator),
            "action": torch.randint(3, (carts, periods), generator=generator),
            "next": {
                "observation": torch.randn(carts, periods, 2, generator=generator),
                "reward": torch.randn(carts, periods, 1, generator=generator),
                "terminated": end < 0.1,
                "done": end < 0.2,
            },
        },
        [carts, periods],
    )


@pytest.mark.parametrize("n", range(1, 6))
@pytest.mark.parametrize("periods", [1, 3, 8, 20])
def test_n_step_transitions_are_those_of_a_loop_over_rows(n: int, periods: int) -> None:
    gamma = 0.9
    chunk = random_chunk(16, periods, seed=n)
    result = n_step_transitions(chunk, n, gamma)
    assert result.batch_size == (16 * periods,)
    for row in range(16):
        for start in range(periods):
            reward, reached = 0.0, start
            for ahead in range(n):
                reached = start + ahead
                reward += gamma**ahead * chunk["next", "reward"][row, reached].item()
                if chunk["next", "done"][row, reached] or reached == periods - 1:
                    break
            got = result[row * periods + start]
            assert got["next", "reward"].item() == pytest.approx(reward, abs=1e-5)
            assert got["steps_to_next_obs"].item() == reached - start + 1
            assert torch.equal(got["observation"], chunk["observation"][row, start])
            assert torch.equal(got["action"], chunk["action"][row, start])
            for key in ("observation", "terminated", "done"):
                assert torch.equal(got["next", key], chunk["next", key][row, reached])


@pytest.mark.parametrize("terminated", [True, False])
def test_a_return_ends_where_the_episode_ends(terminated: bool) -> None:
    """Rewards 1, 10, 100, 1000, the second step ends the episode; the third starts the next."""
    chunk = TensorDict(
        {
            "observation": torch.tensor([[[0.0], [1.0], [20.0], [21.0]]]),
            "action": torch.zeros(1, 4, dtype=torch.long),
            "next": {
                "observation": torch.tensor([[[1.0], [2.0], [21.0], [22.0]]]),
                "reward": torch.tensor([[[1.0], [10.0], [100.0], [1000.0]]]),
                "terminated": torch.tensor([[[False], [terminated], [False], [False]]]),
                "done": torch.tensor([[[False], [True], [False], [False]]]),
            },
        },
        [1, 4],
    )
    result = n_step_transitions(chunk, 3, 0.5)
    assert result["next", "reward"].squeeze(-1).tolist() == [6.0, 10.0, 600.0, 1000.0]
    assert result["steps_to_next_obs"].squeeze(-1).tolist() == [2, 1, 2, 1]
    assert result["next", "observation"].squeeze(-1).tolist() == [2.0, 2.0, 22.0, 22.0]
    assert result["next", "terminated"].squeeze(-1).tolist() == [terminated, terminated, False, False]
    assert result["next", "done"].squeeze(-1).tolist() == [True, True, False, False]


def collected(returns: NStepReturns, chunk: TensorDict, size: int) -> list[TensorDict]:
    """Return the transitions of `returns` for each part of `chunk`, `size` periods long."""
    return [returns(part) for part in chunk.split(size, 1)]


@pytest.mark.parametrize("size", [5, 8, 20])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_carried_returns_are_those_of_one_long_chunk(n: int, size: int) -> None:
    chunk = random_chunk(16, 40, seed=n)
    long = n_step_transitions(chunk, n, 0.9).reshape(16, 40)[:, : 40 - (n - 1)]
    parts = collected(NStepReturns(n, 0.9, carry=True), chunk, size)
    assert [len(part) for part in parts] == [16 * (size - (n - 1))] + [16 * size] * (40 // size - 1)
    together = torch.cat([part.reshape(16, -1) for part in parts], 1)
    assert together.batch_size == long.batch_size
    assert (together == long).all()


def test_without_carry_returns_end_with_their_chunk() -> None:
    chunk = random_chunk(16, 40, seed=0)
    chunk["next", "done"] = torch.zeros(16, 40, 1, dtype=torch.bool)
    for carry, mean in ((False, 3.75), (True, 5.0)):  # 5 - 5 * 4 / (2 * 8)
        parts = collected(NStepReturns(5, 0.9, carry), chunk, 8)
        assert torch.cat(parts)["steps_to_next_obs"].float().mean().item() == pytest.approx(mean)
    alone = [n_step_transitions(part, 5, 0.9) for part in chunk.split(8, 1)]
    assert (torch.cat(collected(NStepReturns(5, 0.9, carry=False), chunk, 8)) == torch.cat(alone)).all()


def test_waiting_periods_are_discarded_at_a_reset() -> None:
    returns, chunk = NStepReturns(3, 0.9, carry=True), random_chunk(16, 8, seed=0)
    first = returns(chunk)
    returns.reset()
    assert (returns(chunk) == first).all()
    assert len(first) == 16 * 6


@pytest.mark.parametrize("periods", [0, 8])
def test_periods_held_back_are_in_the_snapshot(periods: int, tmp_path) -> None:
    returns, chunk = NStepReturns(3, 0.9, carry=True), random_chunk(16, 16, seed=0)
    if periods:
        returns(chunk[:, :periods])
    torch.save(returns.snapshot(), tmp_path / "returns.pt")
    resumed = NStepReturns(3, 0.9, carry=True)
    resumed(chunk[:, 8:])  # of another course
    resumed.restore(torch.load(tmp_path / "returns.pt", weights_only=True))
    for part in (chunk[:, periods : periods + 8], chunk[:, 8:]):
        assert (resumed(part) == returns(part)).all()
