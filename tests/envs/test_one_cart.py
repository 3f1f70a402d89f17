"""One cart on plain numbers does what the TorchRL environment does over the same plant."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import RewardSum
from torchrl.modules import QValueActor

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import GuardedPole, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch, run_episodes
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.settings import NO_ACTION

Simulated = Callable[..., CartPoleEnv]
GUARD = TrackGuard(margin=0.05, delay=0.1, deceleration=3.0)
KNOWING = GUARD.model_copy(update={"pole": GuardedPole(swing=0.8, density=0.4)})
NOISY = {"latency_jitter": Range(absolute=(0.001, 0.01)), "angle_noise": Range(absolute=(1e-4, 1e-3))}
OBSERVATIONS: tuple[dict[str, Any], ...] = (
    {"pole_length": True},
    {"kind": "raw", "past_motors": 0, "past_velocities": 0},
    {"kind": "positions", "past_motors": 3, "past_velocities": 0, "past_positions": 2},
)
SCORES = ("score", "score_upright")
MEMORY = 4  # steps, of an observation and the velocities in it


def compare(tensors: CartPoleEnv, plain: CartPoleEnv, actions: Sequence[int], rounding: int = 0) -> int:
    """Drive both environments and compare every number of every step; return the number of steps.

    A count may differ by `rounding` once in 50 steps, where float32 rounds it otherwise; other numbers are
    then compared again when no observation contains it any more.
    """
    cart, present, percept = plain.one_cart, tensors.reset(), plain.one_cart.reset()
    differed: list[int] = []  # steps
    for number, action in enumerate(actions):
        gap = np.abs(np.array(cart.frame.counts) - present["counts"][0].numpy()).max()
        assert gap <= rounding
        differed += [number] * int(gap)
        if not differed or number - differed[-1] > MEMORY:
            same(percept, present, "state", "past", "observation", "guard", "step_count", *SCORES)
        sent = tensors.hardware.command(present.set("action", torch.tensor([action])))["motor"]
        assert cart.sent_motor(action) == sent.item()
        present, percept = tensors.step(present)["next"], cart.step(action)
        same(percept, present, "terminated", "truncated", "done")
        assert cart.frame.dt[0] == pytest.approx(present["dt"].item())
        assert cart.frame.motor_applied[0] == present["motor_applied"].item()
        if present["done"]:
            same(percept, present, "reward", *SCORES)
            break
        present = present.exclude("reward")
    assert len(differed) <= len(actions) / 50
    return number + 1


def same(percept: Any, present: TensorDictBase, *keys: str) -> None:
    """Check that the numbers of `keys` are those of the tensordict, to the precision of float32."""
    for key in keys:
        np.testing.assert_allclose(getattr(percept, key), present[key][0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("observation", "guard"),
    zip(OBSERVATIONS, (KNOWING, None, GUARD), strict=True),
    ids=["history", "raw", "positions"],
)
def test_a_simulated_cart(
    simulated: Simulated, observation: dict[str, Any], guard: TrackGuard | None
) -> None:
    """With noise, from the same random numbers; to the track's end or the time limit; without an action."""
    plant = {"ranges": NOISY, "seed": 3}
    pair = [simulated(1, plant, time_limit=60, guard=guard, **observation) for _ in range(2)]
    actions = np.random.default_rng(0).choice(3, 60, p=[0.1, 0.2, 0.7]).tolist()
    assert compare(*pair, actions, rounding=1) > 20
    assert (compare(*pair, [2] * 60, rounding=1) == 60) == (guard is not None)
    assert compare(*pair, [2, 2, NO_ACTION, 2], rounding=1) == 3
    cart = pair[1].one_cart
    assert cart.sent_motor(NO_ACTION) == cart.frame.motor_applied[0] == 0


def test_an_action_that_does_not_exist_is_refused_and_a_rehearsal_changes_nothing(
    simulated: Simulated,
) -> None:
    cart = simulated().one_cart
    cart.reset()
    before = cart.frame, cart.percept
    for action in (-2, 3):
        with pytest.raises(IndexError):
            cart.step(action)
    assert all(map(math.isfinite, cart.rehearse().observation))
    assert (cart.frame, cart.percept) == before


def test_the_state_of_a_simulated_cart_stays_in_one_place(make_plant: Callable[..., SimulatedPlant]) -> None:
    """A snapshot between steps of either kind is that of the same cart."""
    plant = make_plant(1, ranges=NOISY)
    plant.reset_one()
    for _ in range(5):
        plant.step_one(200)
    kept = plant.snapshot()
    by_numbers = [plant.step_one(motor).counts for motor in (100, -200, 50)]
    plant.restore(kept)
    by_tensors = [
        plant.step(plant.rand_action().set("motor", torch.tensor([[motor]])))["next"]["counts"]
        for motor in (100, -200, 50)
    ]
    assert [list(each) for each in by_numbers] == [each[0].tolist() for each in by_tensors]
    assert all(math.isfinite(value) for value in plant.origins()[0].state.values())


def test_a_recorded_cart(simulated: Simulated, make_environment: Callable[..., CartPoleEnv]) -> None:
    env = simulated(plant={"cart": {"track_half_length": 0.1}})
    (episode,) = run_batch(env, lambda present: present.set("action", torch.tensor([2])))
    pair = [make_environment(RecordedPlant(episode, None), guard=GUARD) for _ in range(2)]
    assert compare(*pair, [2] * 500) == episode.steps


@pytest.fixture
def driven(make_environment: Callable[..., CartPoleEnv]) -> Iterator[CartPoleEnv]:
    """The environment over an emulated cart."""
    with closing(emulated_plant(EmulatorSettings(physics_step=1e-3))) as plant:
        yield make_environment(plant, time_limit=5)


@torch.no_grad()
@pytest.mark.parametrize("further", [(), (RewardSum(),)], ids=["alone", "transformed"])
def test_values_that_are_not_finite_stop_an_emulated_cart(
    driven: CartPoleEnv, further: Sequence[Any]
) -> None:
    """In TorchRL's own loops; the argmax of NaN values is the first action, full motor to the left."""
    for each in further:
        driven.append_transform(each)
    network = torch.nn.Linear(driven.observation_spec["observation"].shape[-1], 3)
    network.weight.fill_(math.nan)
    actor = QValueActor(network, in_keys=["observation"], spec=driven.action_spec_unbatched)
    rolled = driven.rollout(5, actor)
    assert rolled["action"].tolist() == [[NO_ACTION]]
    assert rolled["next", "motor_applied"].tolist() == [[[0]]]
    assert rolled["next", "truncated"].all()


def test_an_action_that_is_no_integer_is_refused(driven: CartPoleEnv) -> None:
    with pytest.raises(ConfigError, match=r"actions of torch.float32: give the index of a motor value"):
        next(run_episodes(driven, lambda seen: seen.set("action", torch.tensor([1.9])), 1))


def test_transforms_that_an_episode_would_leave_out_are_refused(driven: CartPoleEnv) -> None:
    driven.append_transform(RewardSum())
    with pytest.raises(
        ConfigError, match="leave out the environment's RewardSum: do their work in the policy"
    ):
        next(run_episodes(driven, lambda seen: seen.set("action", torch.tensor([1])), 1))


def test_an_emulated_cart(make_environment: Callable[..., CartPoleEnv]) -> None:
    """Two lockstep carts with the same seed, to the end of the track."""
    plants = [emulated_plant(EmulatorSettings(seed=1, physics_step=1e-3)) for _ in range(2)]
    try:
        pair = [make_environment(plant, time_limit=100) for plant in plants]
        assert 5 < compare(*pair, [0, 2, 1, 0, 2] * 5 + [2] * 75) < 100
        assert pair[0].plant.ended_by == pair[1].plant.ended_by == "track"
    finally:
        for plant in plants:
            plant.close()
