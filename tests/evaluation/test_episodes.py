"""Episodes run from one reset to their first end, on many carts at once, none favoured."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from courses import scattered
from tensordict import TensorDict, TensorDictBase

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import Knocks, run_episodes
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.tasks.settings import Start

RIGHT, NONE = 2, 1  # of the motor values -200, 0, 200
CONSTANT = {"kind": "constant", "scale": 1.0, "track_penalty": 7.0}


def always(action: int) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda seen: seen.set("action", torch.full(seen.batch_size, action))


def test_the_batch_does_not_change_the_count(simulated: Callable) -> None:
    env = simulated(4, time_limit=3)
    for count in (1, 4, 6):
        assert len(list(run_episodes(env, always(NONE), count))) == count


def test_a_fall_ends_an_episode_of_the_balance(simulated: Callable) -> None:
    limit = math.radians(12)
    start = scattered(Start.UPRIGHT, angle_spread=0.05)
    env = simulated(plant={"start": start, "seed": 3}, angle_limit=limit, reward=CONSTANT)
    (episode,) = run_episodes(env, always(NONE), 1)
    assert episode.ended_by == "angle"
    assert abs(episode.theta[-1]) > limit
    assert (np.abs(episode.theta[:-1]) <= limit).all()
    assert (episode.reward == 1).all()  # the penalty is the track's alone


def test_each_row_is_cut_at_its_own_first_end(simulated: Callable) -> None:
    """Carts pushed from different places leave the track one after the other, each once."""
    start = scattered(position_spread=0.3)
    reward = {"track_penalty": 7.0, "scale": 0.5}
    together = simulated(16, {"start": start, "seed": 1}, reward=reward)
    episodes = list(run_episodes(together, always(RIGHT), 16))
    assert len({episode.steps for episode in episodes}) > 4
    by_place = sorted(episodes, key=lambda episode: episode.x[0])
    assert [episode.steps for episode in by_place] == sorted((e.steps for e in episodes), reverse=True)
    for episode in episodes:
        assert episode.ended_by == "track"
        assert (np.abs(episode.x[:-1]) < 0.38 + 1e-4).all()
        assert abs(episode.x[-1]) > 0.38
        penalty = 7 * (np.arange(episode.steps) == episode.steps - 1)
        assert episode.reward == pytest.approx(0.5 * episode.score - penalty, abs=1e-5)


def test_short_episodes_are_not_over_represented(simulated: Callable) -> None:
    """The mean length of 64 episodes on 8 carts is that of 64 carts with an episode each."""
    start = scattered(position_spread=0.3)
    means = []
    for carts in (8, 64):
        env = simulated(carts, {"start": start, "seed": 2})
        episodes = list(run_episodes(env, always(RIGHT), 128))
        means.append(np.mean([episode.steps for episode in episodes]))
        error = np.std([episode.steps for episode in episodes]) / math.sqrt(128)
    assert abs(means[0] - means[1]) < 4 * math.sqrt(2) * error


def test_scores_are_those_of_the_states_that_were_reached(simulated: Callable) -> None:
    env = simulated(plant={"start": scattered(Start.ANY)}, time_limit=100, reward={"scale": 0.2})
    (episode,) = run_episodes(env, always(NONE), 1)
    upright = np.cos(episode.theta[1:] / 2)
    assert episode.score_upright == pytest.approx(
        np.abs(upright) * (1 - np.abs(episode.x[1:]) / 0.38), abs=1e-4
    )
    assert episode.reward == pytest.approx(0.2 * episode.score, abs=1e-5)


def test_the_angle_of_a_pole_that_turns_over_is_not_wrapped(simulated: Callable) -> None:
    env = simulated(time_limit=60)

    def spin(seen: TensorDict) -> TensorDictBase:
        plant: SimulatedPlant = env.plant
        plant.place(plant.true_state._replace(theta_dot=torch.full((1,), 15.0)))
        return always(NONE)(seen)

    (episode,) = run_episodes(env, spin, 1)
    assert episode.theta[-1] - episode.theta[0] > 4 * math.pi
    assert np.abs(np.diff(episode.theta)).max() < math.pi


@pytest.mark.parametrize("unsound", [math.nan, math.inf, -math.inf])
def test_an_action_value_that_is_not_finite_stops_the_motor_and_ends_the_episode(
    simulated: Callable, unsound: float
) -> None:
    """On one cart of three, in the fifth period. The argmax of NaN values is the first action."""
    env, periods = simulated(3, time_limit=20), iter(range(100))

    def policy(seen: TensorDictBase) -> TensorDictBase:
        values = torch.zeros(3, 3)
        values[:, RIGHT] = 1
        if next(periods) == 5:  # the first call is the warm-up
            values[1, 0] = unsound
        return seen.set("action_value", values).set("action", values.argmax(-1))

    episodes = list(run_episodes(env, policy, 3))
    assert [episode.ended_by for episode in episodes] == ["time", "non_finite", "time"]
    assert episodes[1].motor.tolist() == [200] * 4 + [0]
    assert (episodes[0].motor == 200).all()


def test_an_observation_that_is_not_finite_stops_the_motor_and_ends_the_episode(simulated: Callable) -> None:
    """The plant reports a NaN as the duration of the fourth step, so the velocity is NaN."""
    env, calls = simulated(), iter(range(100))

    def policy(seen: TensorDictBase) -> TensorDictBase:
        if next(calls) == 4:  # the first call is the warm-up
            env.plant.period = math.nan  # the period that the plant reports, not the one that it integrates
        return always(RIGHT)(seen)

    (episode,) = run_episodes(env, policy, 1)
    assert episode.ended_by == "non_finite"
    assert episode.motor.tolist() == [200] * 4 + [0]


def test_the_same_seed_gives_the_same_episodes(simulated: Callable) -> None:
    env: CartPoleEnv = simulated(8, {"start": scattered(Start.ANY)}, time_limit=20)
    runs = []
    for seed in (5, 5, 6):
        env.set_seed(seed)
        runs.append(np.concatenate([episode.theta for episode in run_episodes(env, always(RIGHT), 8)]))
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_a_pole_that_stood_for_two_seconds_is_knocked_once_to_either_side_in_turn(
    simulated: Callable,
) -> None:
    env = simulated(2, {"start": scattered(Start.UPRIGHT)}, time_limit=110)  # exactly upright, it stays there
    left_alone = list(run_episodes(env, always(NONE), 2))
    knocked = list(run_episodes(env, always(NONE), 4, Knocks(env.plant, 3.0)))
    assert all(np.abs(each.theta).max() == 0 for each in left_alone)
    for episode, sign in zip(knocked, (1, -1, 1, -1), strict=True):
        assert np.abs(episode.theta[:100]).max() == 0  # rad
        moved = sign * (episode.theta[101] - episode.theta[100])
        assert moved == pytest.approx(3.0 * 0.02, rel=0.1)


def test_a_hanging_pole_is_not_knocked(simulated: Callable) -> None:
    env = simulated(time_limit=150)
    (episode,) = run_episodes(env, always(NONE), 1, Knocks(env.plant, 3.0))
    assert np.ptp(episode.theta) == 0
