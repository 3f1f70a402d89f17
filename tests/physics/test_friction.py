"""The friction laws alone, and a cart that starts, stops and stands under them."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import Drive, State, advance, mechanism, run_period
from cartpole_rl.physics.friction import (
    CART_FRICTIONS,
    POLE_FRICTIONS,
    bearing_torque,
    coulomb_force,
    drag_torque,
    sigmoid_force,
    step_force,
    stribeck_force,
    viscous_coefficient,
)
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters

MakeCart = Callable[..., CartParameters]
STICKING = [law for law in CART_FRICTIONS if law.holds_at_rest]
NO_POLE = {"pole_mass": 1e-9, "pole_com": 1e-3, "pole_inertia": 1e-15}


def at(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def still(x_dot: float = 0.0, theta: float = math.pi) -> State:
    return State(at(0.0), at(x_dot), at(theta), at(0.0))


def push(
    state: State,
    cart: CartParameters,
    law: str,
    force: Tensor | float = 0.0,
    seconds: float = 1.0,
    step: float = 0.01,
) -> list[State]:
    """The states that follow under a constant force on each cart."""
    models = Models.of(cart_friction=law, pole_friction="none", actuator="newtons")
    body, states = mechanism(cart), [state]
    force = torch.as_tensor(force, dtype=torch.float64)
    for _ in range(round(seconds / step)):
        states.append(advance(states[-1], force, cart, body, models, step))
    return states


class TestPower:
    """Friction never pushes along: force against velocity, torque against angular velocity."""

    speeds = torch.cat((torch.linspace(-3, 3, 601, dtype=torch.float64), at(1e-6, -1e-6, 1e-300, -1e-300)))

    @pytest.mark.parametrize("law", [*CART_FRICTIONS, *POLE_FRICTIONS], ids=str)
    def test_of_cart_and_pole(self, make_cart: MakeCart, law: Law) -> None:
        cart = make_cart(len(self.speeds), cart_coulomb_asymmetry=0.5)
        torque = law(self.speeds, cart)
        if law.registry is CART_FRICTIONS:
            torque = -torque - viscous_coefficient(cart, law) * self.speeds
        power = torque * self.speeds
        assert (power <= 0).all()
        assert (power[self.speeds.abs() > 1e-9] < 0).all() == (law != "none")


@pytest.mark.parametrize(("motor", "share"), [(0.0, 0.4), (-51.0, 0.52), (255.0, 1.0)])
def test_a_coasting_motor_brakes_less_the_less_it_is_on(
    make_cart: MakeCart, motor: float, share: float
) -> None:
    """As one whose viscous friction is so much smaller; after its latency, that of the motor value before."""
    seconds, models = 0.02, Models()._replace(cart_friction=CART_FRICTIONS.find("linear"))
    cart = make_cart(cart_viscous=2.0, coasting=0.6, latency=0.005, motor_time_constant=0.0)
    drive = Drive(at(0.0), [at(motor), at(200.0), at(200.0)])
    state, _ = run_period(still(0.3), drive, cart.latency, cart, models, seconds, 4)
    alone, expected = make_cart(cart_viscous=2.0), still(0.3)
    for number in range(4):
        now = at(200.0) if number == 0 else at(motor)
        part = 1 - 0.6 * (1 - 200 / 255) if number == 0 else share
        force = models.actuator(now, alone)
        expected = advance(expected, force, alone, mechanism(alone), models, seconds / 4, at(part))
    torch.testing.assert_close(torch.cat(state), torch.cat(expected))


class TestFormulas:
    speeds = torch.linspace(-0.5, 0.5, 11, dtype=torch.float64)

    def test_linear_is_viscous_alone(self, make_cart: MakeCart) -> None:
        cart, none, linear = (
            make_cart(cart_viscous=1.75),
            *(CART_FRICTIONS.find(x) for x in ("none", "linear")),
        )
        assert viscous_coefficient(cart, linear).item() == 1.75
        assert linear(at(0.3), cart).item() == viscous_coefficient(cart, none).item() == 0

    def test_step_and_sigmoid(self, make_cart: MakeCart) -> None:
        """(5.6) and (5.8)."""
        cart = make_cart(11, cart_coulomb=0.4, sigmoid_slope=100.0)
        torch.testing.assert_close(step_force(self.speeds, cart), 0.4 * torch.sign(self.speeds))
        expected = 0.4 * (2 / (1 + torch.exp(-100 * self.speeds)) - 1)
        torch.testing.assert_close(sigmoid_force(self.speeds, cart), expected)

    def test_stribeck_falls_from_breakaway_to_coulomb(self, make_cart: MakeCart) -> None:
        cart = make_cart(3, cart_coulomb=0.4, cart_stiction_ratio=1.5, stribeck_velocity=0.01)
        expected = at(0.6, 0.4 * (1 + 0.5 / math.e), 0.4)
        torch.testing.assert_close(stribeck_force(at(1e-12, 0.01, 1.0), cart), expected)

    def test_asymmetry_is_more_to_the_right_and_less_to_the_left(self, make_cart: MakeCart) -> None:
        cart = make_cart(2, cart_coulomb=0.5, cart_coulomb_asymmetry=0.2)
        torch.testing.assert_close(coulomb_force(at(0.1, -0.1), cart), at(0.6, 0.4))

    def test_drag_grows_with_the_square_and_bearing_friction_is_constant(self, make_cart: MakeCart) -> None:
        cart = make_cart(2, pole_viscous=0.0, pole_drag=1e-3, pole_coulomb=0.0)
        torch.testing.assert_close(drag_torque(at(2.0, -4.0), cart), at(-4e-3, 16e-3))
        cart = make_cart(3, pole_viscous=0.0, pole_drag=0.0, pole_coulomb=1e-3)
        torch.testing.assert_close(bearing_torque(at(0.0, 0.5, -4.0), cart), at(0.0, -1e-3, 1e-3))


class TestCart:
    @pytest.mark.parametrize("step", [0.02, 0.002])
    @pytest.mark.parametrize("law", STICKING)
    def test_coasts_to_rest_and_stays_there_exactly(self, make_cart: MakeCart, law: str, step: float) -> None:
        cart = make_cart(1, **NO_POLE)
        speeds = torch.cat([state.x_dot for state in push(still(0.5), cart, law, step=step)])
        assert (speeds >= 0).all()
        assert (speeds.diff() <= 0).all()
        assert (speeds[-10:] == 0).all()

    def test_brakes_at_mu_over_m_or_exponentially(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_mass=0.5, cart_coulomb=0.4, cart_viscous=0.0, **NO_POLE)
        middle = push(still(1.0), cart, "step", seconds=0.5)[-1]
        assert middle.x_dot.item() == pytest.approx(1.0 - 0.8 * 0.5)
        cart = make_cart(1, cart_mass=0.5, cart_viscous=1.0, **NO_POLE)
        end = push(still(1.0), cart, "linear", step=1e-3)[-1]
        assert end.x_dot.item() == pytest.approx(math.exp(-2.0), rel=3e-3)

    @pytest.mark.parametrize(("law", "breakaway"), [("step", 0.5), ("stribeck", 0.6)])
    @pytest.mark.parametrize("step", [0.02, 0.002])
    def test_moves_only_above_the_breakaway_force(
        self, make_cart: MakeCart, law: str, breakaway: float, step: float
    ) -> None:
        """To the right and to the left; two of four carts are pushed by less."""
        cart = make_cart(4, cart_coulomb=0.5, cart_stiction_ratio=1.2)
        at_rest, force = (
            State(*(each.repeat(4) for each in still())),
            breakaway * at(0.99, -0.99, 1.01, -1.01),
        )
        states = push(at_rest, cart, law, force, step=step)
        for state in states:
            assert not state.x[:2].any()
            assert not state.x_dot[:2].any()
        assert states[-1].x_dot[2] > 0 > states[-1].x_dot[3]

    def test_breaks_away_with_a_jump_under_stribeck(self, make_cart: MakeCart) -> None:
        """Once it moves, 0.55 N is more than enough; at rest it is not."""
        cart = make_cart(1, cart_coulomb=0.5, cart_stiction_ratio=1.2, cart_viscous=0.0, **NO_POLE)
        assert push(still(), cart, "stribeck", 0.55)[-1].x_dot.item() == 0
        assert push(still(0.05), cart, "stribeck", 0.55)[-1].x_dot.item() > 0.05

    def test_a_stuck_cart_lets_its_pole_swing_as_on_a_wall(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_coulomb=50.0)
        states = push(still(theta=math.pi + 0.02), cart, "step", seconds=3, step=2e-3)
        assert all(state.x.item() == 0 for state in states)
        angle = torch.cat([state.theta for state in states]) - math.pi
        crossings = ((angle[:-1] > 0) & (angle[1:] <= 0)).nonzero().flatten().to(torch.float64) * 2e-3
        moment = cart.pole_mass.item() * GRAVITY * cart.pole_com.item()
        period = 2 * math.pi * math.sqrt(cart.pivot_inertia.item() / moment)
        assert crossings.diff().mean().item() == pytest.approx(period, abs=1e-3)
        assert period == pytest.approx(0.964, abs=0.001)  # Quanser's medium pole


def test_a_small_swing_decays_exponentially(make_cart: MakeCart) -> None:
    """On a cart that does not move: amplitude exp(-b t / (2 J))."""
    cart = make_cart(1, cart_mass=1e9, pole_viscous=1e-3)
    models = Models.of(cart_friction="none", pole_friction="exponential", actuator="newtons")
    body, state, angles = mechanism(cart), still(theta=math.pi + 0.05), []
    for _ in range(6500):
        state = advance(state, at(0.0), cart, body, models, 1e-3)
        angles.append(state.theta.item() - math.pi)
    decay = cart.pole_viscous.item() / (2 * cart.pivot_inertia.item())
    for seconds in (2, 4, 6):
        window = angles[round((seconds - 0.5) / 1e-3) : round((seconds + 0.5) / 1e-3)]
        peak = max(range(len(window)), key=window.__getitem__)
        time = seconds - 0.5 + peak * 1e-3
        assert window[peak] == pytest.approx(0.05 * math.exp(-decay * time), rel=5e-3)


def test_a_pole_that_swings_through_the_bottom_presses_the_cart_onto_the_track(make_cart: MakeCart) -> None:
    cart, slowed = make_cart(), {}
    swinging = State(at(0.0), at(0.5), at(math.pi), at(10.0))
    for presses in (False, True):
        models = Models.of(
            cart_friction="step", pole_friction="none", actuator="newtons", pole_presses=presses
        )
        slowed[presses] = advance(swinging, at(0.0), cart, mechanism(cart), models, 0.01).x_dot.item()
    assert slowed[True] < slowed[False]
