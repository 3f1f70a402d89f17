"""The track guard: when it brakes, what is sent and recorded, and how many carts it keeps on the track."""

from collections.abc import Callable
from contextlib import closing

import numpy as np
import pytest
import torch
from torch import Tensor

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import environment, randomizer, shipped_settings, simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.guard import braking_distances, closest_bound, guard_side, stopping_distance
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.tasks.episode import Ending
from cartpole_rl.tasks.features import MOTOR_SCALE
from cartpole_rl.tasks.settings import NO_ACTION

pytestmark = pytest.mark.usefixtures("all_carts")
GUARD = TrackGuard(margin=0.01, delay=0.1, deceleration=5.0)
END = 0.38  # m
CARTS = 4_000


@pytest.mark.parametrize(
    ("x", "x_dot", "side"),
    [
        (0.0, 0.0, 0),
        (0.36, 0.0, 0),
        (0.375, 0.0, -1),  # within the margin
        (0.0, 1.5, -1),  # 0.01 + 0.15 + 0.225 = 0.385
        (0.17, 1.0, 0),  # 0.01 + 0.1 + 0.1 leave 0.17
        (0.171, 1.0, -1),
        (0.375, -0.5, 0),  # on its way back
        (-0.171, -1.0, 1),
    ],
)
def test_it_brakes_if_the_cart_would_stop_beyond_the_end(x: float, x_dot: float, side: int) -> None:
    assert guard_side(x, x_dot, END, GUARD) == side
    assert guard_side(-x, -x_dot, END, GUARD) == -side
    assert guard_side(torch.tensor([x]), torch.tensor([x_dot]), torch.tensor([END]), GUARD).tolist() == [side]


@pytest.fixture
def env(simulated: Callable[..., CartPoleEnv]) -> CartPoleEnv:
    """Two carts with motor values -250, 0 and 200: the second one is fast and near the right end."""
    return simulated(2, motors=(-250, 0, 200), guard=GUARD, past_motors=1, time_limit=60)


def near_the_end(env: CartPoleEnv) -> None:
    env.plant.place(
        State(*torch.tensor([[0.0, 0.2], [0.0, 1.2], [np.pi, np.pi], [0.0, 0.0]], dtype=torch.float32))
    )


def step(env: CartPoleEnv, current, action: Tensor):
    return env.step(current.set("action", action))["next"]


def test_the_guard_replaces_the_motor_value_of_the_agent(env: CartPoleEnv) -> None:
    current = env.reset()
    near_the_end(env)
    current = step(env, current, torch.tensor([2, 2]))  # the speed is measured from here on
    assert current["guard"].flatten().tolist() == [0, -1]
    for actions, motors in (([NO_ACTION, NO_ACTION], [0, 0]), ([2, 2], [200, -250])):
        command = env.hardware.command(current.set("action", torch.tensor(actions)))
        assert command["motor"].flatten().tolist() == motors
    after = step(env, current, torch.tensor([2, 2]))
    sent = after["past"][:, 0] * MOTOR_SCALE
    assert sent.tolist() == pytest.approx([200, -250])  # the agent observes what was sent


def test_an_episode_holds_the_motor_values_that_were_sent(env: CartPoleEnv) -> None:
    episodes = run_batch(env, lambda td: td.set("action", torch.full((2,), 2)))
    for episode in episodes:
        assert episode.guarded is not None
        assert (episode.motor[episode.guarded] == -250).all()
        assert (episode.motor[~episode.guarded] == 200).all()
        assert 0 < episode.guarded.sum() < episode.steps


def test_the_bound_is_the_least_one_above_all_quantiles() -> None:
    speed = np.linspace(0.1, 2, 20)
    way = 0.02 + 0.1 * speed + speed**2 / 8
    margin, delay, curvature = closest_bound(speed, way)
    assert (margin, delay, curvature) == pytest.approx((0.02, 0.1, 1 / 8))
    lower = way - 0.005 * np.sin(speed * 20) ** 2
    margin, delay, curvature = closest_bound(speed, lower)
    assert (margin + delay * speed + curvature * speed**2 >= lower - 1e-9).all()


def test_a_cart_that_back_emf_brakes_has_a_bound_too() -> None:
    speed = np.linspace(0, 2, 21)
    way = 0.02 + 0.04 * np.sqrt(speed)
    margin, delay, curvature = closest_bound(speed, way)
    assert 0 < curvature < 0.01
    assert (margin + delay * speed + curvature * speed**2 >= way - 1e-9).all()


WEAK_TO_THE_LEFT = {"force_asymmetry": 0.12, "track_tilt": -0.008}


@pytest.mark.parametrize(("quantile", "cart"), [(0.6, None), (0.99, WEAK_TO_THE_LEFT)])
def test_the_share_of_brakings_within_the_bound(quantile: float, cart: dict[str, float] | None) -> None:
    """In both directions, also of a cart that brakes better in one of them."""
    ends = {name: [value, value + 1e-4] for name, value in (cart or {}).items()}
    one = {name: {"distribution": "uniform", "absolute": each} for name, each in ends.items()}
    randomization = one if cart else "wide"
    overrides = {"guard": "fitted", "guard.quantile": quantile, "randomization": randomization}
    settings = with_fitted_guard(shipped_settings(overrides))
    models = settings.models(SimulatedSettings(**choice("plant/simulated")))
    speed, way, rightward = braking_distances(
        randomizer(settings), settings.actions.motors, models, settings.control_period
    )
    within = way <= stopping_distance(speed, settings.guard.active)
    for half in (rightward, ~rightward):
        assert within[half & (speed > 0) & (speed < 2.2)].mean() > quantile - 0.005


def test_motor_values_of_one_sign_are_refused() -> None:
    settings = shipped_settings({"actions": {"motors": [-255, -100, 0], "actuator": "force_curve"}})
    with pytest.raises(ConfigError, match="brake in one direction; choose guard=none"):
        with_fitted_guard(settings)


WEAK_TO_ONE_SIDE = {
    "guard": "bold",
    "actions": {"motors": [-60, 0, 250], "actuator": "force_curve"},
    "cart.cart_coulomb": 0.01,
    "cart.cart_viscous": 0.01,
}
LATE = {"control_period": 0.1, "cart.latency": 0.1, "cart.latency_jitter": 0.1, "guard": "careful"}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (LATE, r"run on by 0\.30\d m before full motor stops them; .* below 0\.3 m: give a shorter"),
        ({**LATE, "cart.track_half_length": 0.2}, r"must be below 0\.2 m: give a shorter"),
        ({"cart.cart_viscous": 1e9}, "not finite; check cart"),
        (WEAK_TO_ONE_SIDE, "full motor does not stop these carts; check masses"),
    ],
)
def test_carts_that_no_guard_keeps_on_the_track_are_refused(
    overrides: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^guard: .*{message}"):
        with_fitted_guard(shipped_settings({"randomization": "none", **overrides}))


# how many carts leave the track


def outward(env: CartPoleEnv, current, number: int, carts: Tensor) -> Tensor:
    """Always full motor to one side."""
    return torch.where(carts % 2 == 0, 0, 8)


def pumping(env: CartPoleEnv, current, number: int, carts: Tensor) -> Tensor:
    """Full motor that pumps energy into the pole."""
    state = current["state"]
    return torch.where(state[:, 3] * torch.cos(state[:, 2]) > 0, 0, 8)


def reversing(env: CartPoleEnv, current, number: int, carts: Tensor) -> Tensor:
    """Full motor, reversed at random after half a second: the fastest way to the ends."""
    generator = torch.Generator().manual_seed(number // 25)
    return torch.where(torch.rand(len(carts), generator=generator) < 0.5, 0, 8)


@pytest.mark.parametrize(
    ("policy", "guard"),
    [(outward, "fitted"), (pumping, "fitted"), (reversing, "fitted"), (outward, "careful")],
)
def test_no_sequence_of_actions_overruns_the_quantile(
    policy: Callable[[CartPoleEnv, object, int, Tensor], Tensor], guard: str
) -> None:
    """Of all brakings of 4 000 carts that the fit has not seen, no larger share ends off the track."""
    settings = with_fitted_guard(shipped_settings({"guard": guard}))
    plant = SimulatedSettings(**choice("plant/simulated"))
    env = simulated_env(settings, plant, CARTS, settings.task.evaluation_start, seed=20_000)
    current, carts = env.reset(), torch.arange(CARTS)
    driven = torch.ones(CARTS, dtype=torch.bool)
    braking, brakings, lost = torch.zeros_like(driven), 0, 0
    for number in range(120):
        now = current["guard"].squeeze(1) != 0
        brakings += int((now & ~braking & driven).sum())
        braking = now
        current = step(env, current, policy(env, current, number, carts)).exclude("reward")
        off = current["terminated"].squeeze(1) & driven
        lost += int(off.sum())
        driven &= ~off
    assert brakings > CARTS
    assert lost <= (1 - settings.guard.quantile) * brakings


def test_an_emulated_cart_stays_on_the_track() -> None:
    """The guard reads where the track of the cart ends, from the span that the cart measured."""
    settings = with_fitted_guard(shipped_settings({"guard": "careful", "task.time_limit": 150}))
    plant = emulated_plant(EmulatorSettings(physics_step=1e-3, cart_viscous=0.1, latency=0.015))
    with closing(environment(settings, plant)) as env:
        for action in (0, 8):
            (episode,) = run_batch(env, lambda td, action=action: td.set("action", torch.tensor([action])))
            assert episode.ended_by == Ending.TIME
            assert episode.guarded is not None
            assert episode.guarded.any()
