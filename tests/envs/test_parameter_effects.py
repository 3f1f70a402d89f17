"""Drawn parameters have an effect, through the environment, in the first episode and in the next.

One for each route: cart, pole, motor, link and encoders; plants/test_effects.py has all of them.
32 carts start alike and get the same actions; one parameter is drawn for each. The two carts whose values lie
farthest apart have to end in different states. Parameters of chance are judged by the spread that they cause.
"""

from collections.abc import Callable

import pytest
import torch
from courses import scattered
from torch import Tensor

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.settings import Start

CARTS, STEPS = 32, 20
UPRIGHT = scattered(Start.UPRIGHT)
# the bounds of a parameter
CASES: dict[str, tuple[float, float]] = {
    "cart_mass": (0.5, 0.9),
    "pole_com": (0.1, 0.3),
    "deadband_left": (0.0, 200.0),
    "latency": (0.0, 0.06),
    "angle_offset": (-0.05, 0.05),
}
CHANCE = {"latency_jitter": (0.0, 0.05), "position_noise": (0.0, 0.01), "angle_noise": (0.0, 0.05)}
MOTORS = {"deadband_left": 100}
CARTS_OF = {"latency_jitter": {"latency": 0.05}}


@pytest.fixture(scope="module")
def randomized(simulated: Callable[..., CartPoleEnv]) -> Callable[..., CartPoleEnv]:
    """Carts of which one parameter is drawn."""

    def build(
        name: str, bounds: tuple[float, float], carts: int = CARTS, time_limit: int = STEPS
    ) -> CartPoleEnv:
        motor = MOTORS.get(name, 200)
        plant = {
            "cart": {"track_half_length": 10.0, **CARTS_OF.get(name, {})},
            "ranges": {name: Range(absolute=bounds)},
            "start": UPRIGHT,
            "models": Models.of(cart_friction="sigmoid", pole_friction="bearing"),
        }
        return simulated(carts, plant, motors=(-motor, motor), time_limit=time_limit)

    return build


def two_episodes(env: CartPoleEnv) -> list[tuple[CartParameters, Tensor]]:
    """Of each episode: the parameters in force, and the counts [T, N, 2] under the same actions for all."""
    present, episodes = env.reset(), []
    for _ in range(2):
        drawn, counts = env.plant.parameters.clone(), []
        for step in range(STEPS):
            rightward = torch.full((env.plant.carts,), int((step // 6) % 2 == 0))
            transition, present = env.step_and_maybe_reset(present.set("action", rightward))
            counts.append(transition["next", "counts"])
        assert transition["next", "truncated"].all()
        episodes.append((drawn, torch.stack(counts)))
    return episodes


@pytest.mark.parametrize("name", CASES)
def test_another_value_ends_in_another_state(randomized: Callable[..., CartPoleEnv], name: str) -> None:
    episodes = two_episodes(randomized(name, CASES[name]))
    for drawn, counts in episodes:
        value = getattr(drawn, name)
        least, most = value.argmin(), value.argmax()
        assert value[most] > value[least]
        assert (counts[-1, least] != counts[-1, most]).any()
    assert (getattr(episodes[0][0], name) != getattr(episodes[1][0], name)).all()


def test_equal_values_end_in_equal_states(randomized: Callable[..., CartPoleEnv]) -> None:
    """Control for the test above: equal parameters cause no difference."""
    for _, counts in two_episodes(randomized("cart_mass", (0.7, 0.7))):
        assert (counts == counts[:, :1]).all()


@pytest.mark.parametrize("name", CHANCE)
def test_larger_noise_spreads_wider(randomized: Callable[..., CartPoleEnv], name: str) -> None:
    """The half of the carts with larger values strays half as far again, or more, from the middle course."""
    for drawn, counts in two_episodes(randomized(name, CHANCE[name], carts=256)):
        large = getattr(drawn, name) > sum(CHANCE[name]) / 2
        stray = (counts - counts.median(1, keepdim=True).values).abs().float().mean((0, 2))
        assert stray[large].mean() > 1.5 * stray[~large].mean()


def test_a_shorter_track_ends_sooner(randomized: Callable[..., CartPoleEnv]) -> None:
    env = randomized("track_half_length", (0.05, 0.3), time_limit=500)
    present, lengths = env.reset(), [[] for _ in range(CARTS)]
    limits = [[limit] for limit in env.plant.parameters.track_half_length.tolist()]
    for _ in range(120):
        rightward = torch.ones(CARTS, dtype=torch.long)
        transition, present = env.step_and_maybe_reset(present.set("action", rightward))
        following = transition["next"]
        for row in following["terminated"].flatten().nonzero().flatten().tolist():
            lengths[row].append(following["step_count"][row].item())
            limits[row].append(env.plant.parameters.track_half_length[row].item())
    for episode in (0, 1):
        by_limit = sorted(
            (limit[episode], length[episode]) for limit, length in zip(limits, lengths, strict=True)
        )
        steps = [length for _, length in by_limit]
        assert steps == sorted(steps)
        assert steps[0] < steps[-1]
    assert all(limit[0] != limit[1] for limit in limits)
