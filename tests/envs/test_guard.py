"""The track guard: when it brakes, what is sent and recorded, and how many carts it keeps on the track."""

from collections.abc import Callable
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import (
    environment,
    guarded_pole,
    randomizer,
    shipped_settings,
    simulated_env,
    with_fitted_guard,
)
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.guard import (
    Brakings,
    Centre,
    braking_distances,
    centre_of_mass,
    guard_direction,
    guard_side,
    least_bound,
    stopping_distance,
)
from cartpole_rl.envs.settings import GuardedPole, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.tasks.episode import Ending
from cartpole_rl.tasks.features import MOTOR_SCALE, Measured
from cartpole_rl.tasks.settings import NO_ACTION
from examples.drive_without_torch import guarded

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
    assert direction(x, x_dot, 0.5, -3.0, GUARD) == side


def direction(
    x: float, x_dot: float, theta: float, theta_dot: float, guard: TrackGuard, length: float | None = None
) -> int:
    motion = Measured(*torch.tensor([[x], [x_dot], [theta], [theta_dot]]))
    observed = None if length is None else torch.tensor([length])
    return guard_direction(motion, torch.tensor([END]), guard, observed).item()


# A pole of 0.4 m with the mass of the cart: r is half of 0.2 m, and 1 + mu is 2
POLE = GuardedPole(swing=0.5, density=2.5, length=0.4)
WITH_POLE = TrackGuard(margin=0.01, delay=0.1, deceleration=5.0, pole=POLE)


@pytest.mark.parametrize(
    ("x", "x_dot", "theta", "theta_dot", "side"),
    [
        (0.019, 1.0, np.pi, 0.0, 0),  # 0.01 + 0.1 + 0.5 * 0.1 + 2 * 0.1 leave 0.02
        (0.021, 1.0, np.pi, 0.0, -1),
        (0.069, 1.0, -np.pi / 2, 0.0, 0),  # the centre of mass is on the left already: 0.05 more are free
        (0.071, 1.0, -np.pi / 2, 0.0, -1),
        (-0.031, 1.0, np.pi / 2, 0.0, 0),
        (-0.029, 1.0, np.pi / 2, 0.0, -1),
        (0.219, 1.0, np.pi, 10.0, 0),  # the centre of mass rests: 1 - 0.1 * 10
        (0.221, 1.0, np.pi, 10.0, -1),
        (0.36, -0.05, -np.pi / 2, 0.0, 0),  # the cart creeps back from the end, the pole lies inward
        (0.37, -0.05, np.pi, 0.0, -1),  # it could be driven outward again
    ],
)
@pytest.mark.parametrize("observed", [False, True])
def test_a_guard_that_knows_the_pole_brakes_the_centre_of_mass(
    x: float, x_dot: float, theta: float, theta_dot: float, side: int, observed: bool
) -> None:
    length = 0.4 if observed else None
    known = POLE.model_copy(update={"length": None if observed else 0.4})
    guard = WITH_POLE.model_copy(update={"pole": known})
    assert direction(x, x_dot, theta, theta_dot, guard, length) == side
    assert direction(-x, -x_dot, -theta, -theta_dot, guard, length) == -side


def test_one_of_two_guards_brakes() -> None:
    both = WITH_POLE.model_copy(update={"also": GUARD})
    assert direction(0.1, 1.0, np.pi, 0.0, both) == -1  # the one with the pole
    assert direction(-0.171, -1.0, np.pi, -10.0, both) == 1  # the other one
    assert direction(0.0, 0.5, np.pi, 0.0, both) == 0


OBSERVED = WITH_POLE.model_copy(update={"pole": POLE.model_copy(update={"length": None})})


@pytest.mark.parametrize("guard", [GUARD, WITH_POLE, OBSERVED, WITH_POLE.model_copy(update={"also": GUARD})])
def test_the_example_without_pytorch_brakes_where_the_guard_does(guard: TrackGuard) -> None:
    agent = SimpleNamespace(guard=guard, motors=(-250, 0, 200))
    random, sides = np.random.default_rng(0), {-1: -250, 0: 0, 1: 200}
    seen = set()
    for x, x_dot, theta, theta_dot in random.uniform(-1, 1, (500, 4)) * (0.38, 1.5, np.pi, 12.0):
        side = direction(x, x_dot, theta, theta_dot, guard, 0.4)
        now = {"x": x, "x_dot": x_dot, "theta_dot": theta_dot, "pole_length": 0.4}
        now |= {"sin_theta": np.sin(theta), "cos_theta": np.cos(theta)}
        assert guarded(agent, 0, now, END) == sides[side]
        seen.add(side)
    assert seen == {-1, 0, 1}


def test_without_forces_the_centre_of_mass_keeps_its_speed() -> None:
    """The pole moves the cart to and fro, by the same numbers that the guard computes with."""
    still = {f"cart.{name}": 0.0 for name in ("cart_viscous", "cart_coulomb", "pole_viscous")}
    settings = shipped_settings({"randomization": "none", "guard": "none", "pole": "large", **still})
    plant = SimulatedSettings(**{**choice("plant/simulated"), "substeps": 64})
    env = simulated_env(settings, plant, 1, settings.task.evaluation_start, seed=0)
    current = env.reset()
    env.plant.place(State(*torch.tensor([[0.0], [0.1], [2.0], [4.0]])))
    speeds, centres = [], []
    for _ in range(50):
        motion = Measured(*env.plant.true_state)
        speeds.append(motion.x_dot.item())
        centres.append(centre_of_mass(motion, guarded_pole(settings), None).speed.item())
        current = step(env, current, torch.tensor([4]))
    assert np.ptp(centres) < 0.002
    assert np.ptp(speeds) > 0.5


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


def brakings(way: Callable[[Tensor, Centre], Tensor], noise: float = 0.0) -> Brakings:
    """Return brakings of carts with POLE, whose way is a function of speed and of the terms of the pole."""
    generator = torch.Generator().manual_seed(0)
    count = 8192
    speed, theta, turning, late = torch.rand(4, count, generator=generator)
    motion = Measured(torch.zeros(count), 2 * speed, 6.28 * theta, 8 * turning - 4)
    ways = way(motion.x_dot, centre_of_mass(motion, POLE, None)) + noise * late
    return Brakings(motion, torch.full((count,), 0.4), torch.ones(count, dtype=torch.bool), ways)


def test_the_fit_finds_the_numbers_and_the_quantile() -> None:
    def way(x_dot: Tensor, centre: Centre) -> Tensor:
        moment = centre.mass * centre.speed * centre.speed.abs()
        return 0.02 + 0.1 * x_dot + 0.6 * (centre.reach + centre.offset) + moment / 8

    assert least_bound(brakings(way), POLE, 0.9) == pytest.approx([0.02, 0.1, 0.6, 1 / 8], abs=1e-4)
    late = least_bound(brakings(way, noise=0.1), POLE, 0.9)
    assert late == pytest.approx([0.02 + 0.09, 0.1, 0.6, 1 / 8], abs=0.01)


def test_a_cart_that_back_emf_brakes_has_a_bound_too() -> None:
    numbers = least_bound(brakings(lambda x_dot, centre: 0.02 + 0.04 * x_dot.sqrt()), POLE, 0.9)
    assert (numbers >= 0).all()
    assert numbers[3] < 0.01


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
    guard = settings.guard.active
    found = braking_distances(randomizer(settings), settings.actions.motors, models, settings.control_period)
    centre = centre_of_mass(found.motion, guard.pole, None)
    within = found.way <= stopping_distance(found.motion.x_dot, guard, centre)
    for half in (found.rightward, ~found.rightward):
        assert within[half].float().mean() > quantile - 0.005


def test_motor_values_of_one_sign_are_refused() -> None:
    settings = shipped_settings({"actions": {"motors": [-255, -100, 0], "actuator": "force_curve"}})
    with pytest.raises(ConfigError, match="brake in one direction; choose guard=none"):
        with_fitted_guard(settings)


def test_a_pole_of_unknown_length_is_refused() -> None:
    numbers = OBSERVED.model_dump(mode="json")
    plant = SimulatedSettings(**choice("plant/simulated"))
    for overrides in ({"guard.numbers": numbers}, {"guard.numbers": {**GUARD.model_dump(), "also": numbers}}):
        settings = shipped_settings(overrides)
        with pytest.raises(ConfigError, match=r"does not observe its pole; give pole\.length in m"):
            simulated_env(settings, plant, 1, settings.task.evaluation_start, seed=0)


WEAK_TO_ONE_SIDE = {
    "guard": "bold",
    "actions": {"motors": [-60, 0, 250], "actuator": "force_curve"},
    "cart.cart_coulomb": 0.01,
    "cart.cart_viscous": 0.01,
}
LATE = {"control_period": 0.1, "cart.latency": 0.1, "cart.motor_time_constant": 0.03, "guard": "careful"}
LIGHT = {"choices": {"light": {"pole_mass": 0.01, "pole_com": 0.1778, "pole_inertia": 1e-4}}}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (LATE, r"run on by 0\.4\d\d m before full motor stops them; .* below 0\.38 m: give a shorter"),
        (
            {**LATE, "cart.motor_time_constant": 0.08, "pole": LIGHT},
            r"run on by 0\.3\d\d m before .* below 0\.3 m: give a shorter",
        ),
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
    [
        (outward, "fitted"),
        (pumping, "fitted"),
        (reversing, "fitted"),
        (outward, "careful"),
        (reversing, "careful"),
    ],
)
def test_no_sequence_of_actions_overruns_the_quantile(
    policy: Callable[[CartPoleEnv, object, int, Tensor], Tensor], guard: str
) -> None:
    """Of the brakings of 4 000 carts that the fit has not seen, no larger share ends off the track."""
    settings = with_fitted_guard(shipped_settings({"guard": guard}))
    plant = SimulatedSettings(**choice("plant/simulated"))
    env = simulated_env(settings, plant, CARTS, settings.task.evaluation_start, seed=20_000)
    current, carts = env.reset(), torch.arange(CARTS)
    driven = torch.ones(CARTS, dtype=torch.bool)
    braking, brakings, lost = torch.zeros_like(driven), 0, 0
    for number in range(300):
        now = current["guard"].squeeze(1) != 0
        brakings += int((now & ~braking & driven).sum())
        braking = now
        current = step(env, current, policy(env, current, number, carts)).exclude("reward")
        off = current["terminated"].squeeze(1) & driven
        lost += int(off.sum())
        driven &= ~off
    assert brakings > CARTS
    late = 1 - settings.guard.quantile
    assert lost <= late * brakings
    assert lost <= 2 * late * CARTS  # in six seconds, in which a cart brakes some twenty times


def test_an_emulated_cart_stays_on_the_track() -> None:
    """The guard reads where the track of the cart ends, from the span that the cart measured."""
    settings = with_fitted_guard(shipped_settings({"guard": "careful", "task.time_limit": 1000}))
    plant = emulated_plant(EmulatorSettings(physics_step=1e-3, cart_viscous=0.1, latency=0.015))
    with closing(environment(settings, plant)) as env:
        for action in (0, 8):
            (episode,) = run_batch(env, lambda td, action=action: td.set("action", torch.tensor([action])))
            assert episode.ended_by == Ending.TIME
            assert episode.guarded is not None
            assert episode.guarded.any()
