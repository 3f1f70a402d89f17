"""The collector: consistent transitions, the share of random actions, retries, and resuming to the bit."""

from collections.abc import Callable

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector as TorchRLCollector

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import shipped_settings, simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.learning.collector import COLLECTED, Collector
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.settings import Start, StartSettings

CARTS, LIMIT = 64, 20
SCALE = {"scale": 0.1}  # of the reward


@pytest.fixture
def env(make_plant: Callable, make_environment: Callable) -> CartPoleEnv:
    return make_environment(make_plant(CARTS, seed=5), time_limit=LIMIT)


def always(action: int) -> TensorDictModule:
    """A policy."""
    return TensorDictModule(
        lambda seen: torch.full(seen.shape[:1], action), in_keys=["observation"], out_keys=["action"]
    )


def collector(env: CartPoleEnv, action: int = 1, seed: int = 0) -> Collector:
    return Collector(env, always(action), actions=3, seed=seed)


def test_shapes_and_keys(env: CartPoleEnv) -> None:
    chunk = collector(env).collect(4)
    assert chunk.batch_size == (CARTS, 4)
    assert set(chunk.keys(True, True)) == set(COLLECTED)


def test_each_transition_starts_where_the_last_one_ended(env: CartPoleEnv) -> None:
    chunk = collector(env).collect(3 * LIMIT)
    ended = chunk["next", "done"].squeeze(-1)[:, :-1]
    follows = (chunk["next", "observation"][:, :-1] == chunk["observation"][:, 1:]).all(-1)
    assert ended.any()
    assert follows[~ended].all()
    assert not follows[ended].any()  # a new episode begins at a state of its own


def test_transitions_equal_those_of_torchrls_collector_and_rollout(
    make_plant: Callable, make_environment: Callable
) -> None:
    """The same seed and policy give the same transitions, to the bit, over resets of single carts."""
    torch.manual_seed(0)
    layer = torch.nn.Linear(10, 3)
    policy = TensorDictModule(
        lambda seen: (10 * layer(seen)).argmax(-1), in_keys=["observation"], out_keys=["action"]
    )
    start = StartSettings(
        angle=Start.ANY, position_spread=0.3, angle_spread=0, speed_spread=0.5, angular_speed_spread=1.0
    )

    def build() -> CartPoleEnv:
        return make_environment(make_plant(CARTS, start=start, seed=3), time_limit=LIMIT)

    ours = Collector(build(), policy, actions=3, seed=0)
    ours.epsilon = 0.0
    chunk, periods = ours.collect(3 * LIMIT), 3 * LIMIT
    stock = TorchRLCollector(build(), policy, frames_per_batch=CARTS * periods, total_frames=CARTS * periods)
    with torch.no_grad():
        rollout = build().rollout(periods, policy, break_when_any_done=False)
    for other in (next(iter(stock)), rollout):
        for key in COLLECTED:
            assert torch.equal(chunk[key], other[key]), key
    assert len(chunk["action"].unique()) == 3
    assert 0 < chunk["next", "terminated"].sum() < chunk["next", "done"].sum()


def test_epsilon_is_the_share_of_random_actions(env: CartPoleEnv) -> None:
    acting = collector(env, action=1)
    shares = []
    for epsilon in (0.0, 0.5, 1.0):
        acting.epsilon = epsilon
        shares.append((acting.collect(60)["action"] != 1).float().mean().item())
    assert shares == pytest.approx([0.0, 0.5 * 2 / 3, 2 / 3], abs=0.03)  # a third of the random ones is 1 too


def test_finished_episodes_are_reported_once(env: CartPoleEnv) -> None:
    acting = collector(env)
    acting.epsilon = 0.0
    acting.collect(LIMIT - 1)
    assert acting.finished() == {}
    acting.collect(1)
    finished = acting.finished()
    assert finished["episode_length"] == LIMIT
    assert abs(finished["score"]) < 1e-4  # a still, hanging pole has cos(theta / 2) = 0
    assert acting.finished() == {}


def test_equal_seeds_act_alike_and_others_do_not(make_plant: Callable, make_environment: Callable) -> None:
    chunks = [
        collector(make_environment(make_plant(CARTS, seed=5)), seed=seed).collect(5) for seed in (1, 1, 2)
    ]
    assert (chunks[0] == chunks[1]).all()
    assert not torch.equal(chunks[0]["action"], chunks[2]["action"])


def test_a_restored_collector_continues_to_the_bit(make_plant: Callable, make_environment: Callable) -> None:
    def build(seed: int) -> Collector:
        return collector(make_environment(make_plant(CARTS, seed=seed), time_limit=LIMIT), seed=seed)

    first, second = build(1), build(2)
    first.collect(LIMIT + 3)
    acting, plant = first.snapshot(), first.env.plant.snapshot()
    ahead = first.collect(2 * LIMIT)
    second.restore(acting)
    second.env.plant.restore(plant)
    assert (second.collect(2 * LIMIT) == ahead).all()
    assert second.finished() == first.finished()


@pytest.mark.parametrize("share", [0.0, 0.75])
def test_a_failed_cart_is_retried(make_plant: Callable, make_environment: Callable, share: float) -> None:
    """Poles that start a little off upright: some have enough friction to stand for a second, some fall."""
    viscous = Range(distribution="log_uniform", absolute=(1e-4, 10.0))
    near = StartSettings(
        angle=Start.UPRIGHT, position_spread=0, angle_spread=0.04, speed_spread=0, angular_speed_spread=0
    )
    plant = make_plant(CARTS, ranges={"pole_viscous": viscous}, start=near, seed=5)
    acting = Collector(
        make_environment(plant, time_limit=100, angle_limit=0.2, reward=SCALE), always(1), 3, 0, share
    )
    acting.epsilon = 0.0
    acting.collect(1000)  # what is usual is known from here on
    acting.reset()
    score, failed, stood = torch.zeros(CARTS), [], []
    for _ in range(500):
        before = plant.parameters.pole_viscous.clone()
        following = acting.collect(1)["next"][:, 0]
        same = plant.parameters.pole_viscous == before
        score += following["reward"].squeeze(-1) / SCALE["scale"] / 1100  # of the most that is possible
        for row in following["done"].squeeze(-1).nonzero().squeeze(-1).tolist():
            if score[row] < 0.25:
                failed.append(float(same[row]))
            elif score[row] > 0.75:
                stood.append(float(same[row]))
            score[row] = 0
    assert len(failed) > 200
    assert len(stood) > 50
    assert sum(stood) == 0
    assert sum(failed) / len(failed) == pytest.approx(share, abs=0.05)


def test_the_share_of_periods_under_the_track_guard() -> None:
    """It is the share of motor values sent that are not those of the agent's actions."""

    def build(guard: str) -> CartPoleEnv:
        settings = with_fitted_guard(shipped_settings({"guard": guard}))
        plant = SimulatedSettings(**choice("plant/simulated"))
        return simulated_env(settings, plant, CARTS, settings.task.start, seed=5)

    env, outward = build("careful"), 8
    driven = Collector(env, always(outward), actions=9, seed=0)
    driven.epsilon = 0.0
    driven.collect(LIMIT)
    driven.collect(LIMIT)
    replaced, again = 0, build("careful")
    current = again.reset()
    for _ in range(2 * LIMIT):
        current["action"] = torch.full((CARTS,), outward)
        replaced += int((again.hardware.command(current)["motor"] != env.hardware.motors[outward]).sum())
        _, current = again.step_and_maybe_reset(current)
    assert 0 < replaced < 2 * LIMIT * CARTS
    assert driven.guarded_fraction() == {"guarded_fraction": replaced / (2 * LIMIT * CARTS)}
    assert driven.guarded_fraction() == {}
    unguarded = Collector(build("none"), always(outward), actions=9, seed=0)
    unguarded.collect(LIMIT)
    assert unguarded.guarded_fraction() == {}
