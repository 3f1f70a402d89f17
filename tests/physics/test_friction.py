"""The friction models alone, and a cart that starts, stops and stands under them."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.dynamics import State, advance, mechanism, speed_lost
from cartpole_rl.physics.friction import (
    CART_FRICTIONS,
    POLE_FRICTIONS,
    coulomb_force,
    viscous_coefficient,
)
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters

MakeCart = Callable[..., CartParameters]
STICKING = [model for model in CART_FRICTIONS if model.holds_at_rest]
DRY = [model for model in CART_FRICTIONS if model.has_formula]
NO_POLE = {"pole_mass": 1e-9, "pole_com": 1e-3, "pole_inertia": 1e-15}


def at(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def still(x_dot: float = 0.0, theta: float = math.pi) -> State:
    return State(at(0.0), at(x_dot), at(theta), at(0.0))


def push(
    state: State,
    cart: CartParameters,
    model: Law,
    force: float = 0.0,
    seconds: float = 1.0,
    step: float = 0.01,
) -> list[State]:
    """The states that follow under a constant force on the cart."""
    models = Models(model, POLE_FRICTIONS.find("none"), ACTUATORS.find("newtons"))
    body, states = mechanism(cart), [state]
    for _ in range(round(seconds / step)):
        states.append(advance(states[-1], at(force), cart, body, models, step))
    return states


def test_which_models_stick_and_which_are_dry() -> None:
    assert STICKING == ["step", "stribeck"]
    assert DRY == ["sigmoid", "step", "stribeck"]


class TestPower:
    """Friction never pushes along: force against velocity, torque against angular velocity."""

    speeds = torch.cat((torch.linspace(-3, 3, 601, dtype=torch.float64), at(1e-6, -1e-6, 1e-300, -1e-300)))

    @pytest.mark.parametrize("model", CART_FRICTIONS)
    def test_of_the_cart(self, make_cart: MakeCart, model: Law) -> None:
        cart = make_cart(len(self.speeds), cart_coulomb_asymmetry=0.5)
        force = model(self.speeds, cart) + viscous_coefficient(cart, model) * self.speeds
        power = -force * self.speeds
        assert (power <= 0).all()
        moving = self.speeds.abs() > 1e-9
        assert (power[moving] < 0).all() == (model is not CART_FRICTIONS.find("none"))

    @pytest.mark.parametrize("model", POLE_FRICTIONS)
    def test_of_the_pole(self, make_cart: MakeCart, model: Law) -> None:
        cart = make_cart(len(self.speeds))
        power = model(self.speeds, cart) * self.speeds
        assert (power <= 0).all()
        assert (power[self.speeds.abs() > 1e-9] < 0).all() == (model is not POLE_FRICTIONS.find("none"))

    @pytest.mark.parametrize("model", DRY)
    def test_of_a_step(self, make_cart: MakeCart, model: Law) -> None:
        cart = make_cart(len(self.speeds))
        lost = speed_lost(self.speeds, self.speeds, at(0.02), cart, model)
        assert (lost * self.speeds >= 0).all()


class TestFormulas:
    speeds = torch.linspace(-0.5, 0.5, 11, dtype=torch.float64)

    def test_linear_is_5_7(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_viscous=1.75)
        assert viscous_coefficient(cart, CART_FRICTIONS.find("linear")).item() == 1.75
        assert CART_FRICTIONS.find("linear")(at(0.3), cart).item() == 0
        assert viscous_coefficient(cart, CART_FRICTIONS.find("none")).item() == 0

    def test_step_is_5_6(self, make_cart: MakeCart) -> None:
        force = CART_FRICTIONS.find("step")(self.speeds, make_cart(11, cart_coulomb=0.4))
        torch.testing.assert_close(force, 0.4 * torch.sign(self.speeds))

    def test_sigmoid_is_5_8(self, make_cart: MakeCart) -> None:
        cart = make_cart(11, cart_coulomb=0.4, sigmoid_slope=100.0)
        expected = 0.4 * (2 / (1 + torch.exp(-100 * self.speeds)) - 1)
        torch.testing.assert_close(CART_FRICTIONS.find("sigmoid")(self.speeds, cart), expected)

    def test_stribeck_falls_from_breakaway_to_coulomb(self, make_cart: MakeCart) -> None:
        cart = make_cart(3, cart_coulomb=0.4, cart_stiction_ratio=1.5, stribeck_velocity=0.01)
        force = CART_FRICTIONS.find("stribeck")(at(1e-12, 0.01, 1.0), cart)
        torch.testing.assert_close(force, at(0.6, 0.4 * (1 + 0.5 / math.e), 0.4))

    def test_asymmetry_is_more_to_the_right_and_less_to_the_left(self, make_cart: MakeCart) -> None:
        cart = make_cart(2, cart_coulomb=0.5, cart_coulomb_asymmetry=0.2)
        torch.testing.assert_close(coulomb_force(at(0.1, -0.1), cart), at(0.6, 0.4))

    def test_drag_grows_with_the_square(self, make_cart: MakeCart) -> None:
        cart = make_cart(2, pole_viscous=0.0, pole_drag=1e-3)
        torque = POLE_FRICTIONS.find("exponential_drag")(at(2.0, -4.0), cart)
        torch.testing.assert_close(torque, at(-4e-3, 16e-3))

    def test_bearing_friction_is_constant_except_at_low_speed(self, make_cart: MakeCart) -> None:
        cart = make_cart(3, pole_viscous=0.0, pole_drag=0.0, pole_coulomb=1e-3)
        torque = POLE_FRICTIONS.find("bearing")(at(0.0, 0.5, -4.0), cart)
        torch.testing.assert_close(torque, at(0.0, -1e-3, 1e-3))


class TestCart:
    @pytest.mark.parametrize("step", [0.02, 0.01, 0.002])
    @pytest.mark.parametrize("model", STICKING)
    def test_coasts_to_rest_and_stays_there_exactly(
        self, make_cart: MakeCart, model: Law, step: float
    ) -> None:
        cart = make_cart(1, **NO_POLE)
        speeds = torch.cat([state.x_dot for state in push(still(0.5), cart, model, step=step)])
        assert (speeds >= 0).all()
        assert (speeds.diff() <= 0).all()
        assert (speeds[-10:] == 0).all()

    def test_step_friction_brakes_at_mu_over_m(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_mass=0.5, cart_coulomb=0.4, cart_viscous=0.0, **NO_POLE)
        middle = push(still(1.0), cart, CART_FRICTIONS.find("step"), seconds=0.5)[-1]
        assert middle.x_dot.item() == pytest.approx(1.0 - 0.8 * 0.5)

    def test_viscous_friction_brakes_exponentially(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_mass=0.5, cart_viscous=1.0, **NO_POLE)
        end = push(still(1.0), cart, CART_FRICTIONS.find("linear"), step=1e-3)[-1]
        assert end.x_dot.item() == pytest.approx(math.exp(-2.0), rel=3e-3)

    @pytest.mark.parametrize(
        ("model", "breakaway"), [(CART_FRICTIONS.find("step"), 0.5), (CART_FRICTIONS.find("stribeck"), 0.6)]
    )
    @pytest.mark.parametrize("step", [0.02, 0.01, 0.002])
    @pytest.mark.parametrize("side", [1, -1])
    def test_moves_only_above_the_breakaway_force(
        self, make_cart: MakeCart, model: Law, breakaway: float, step: float, side: int
    ) -> None:
        cart = make_cart(1, cart_coulomb=0.5, cart_stiction_ratio=1.2)
        for state in push(still(), cart, model, side * 0.99 * breakaway, step=step):
            assert state.x.item() == 0
            assert state.x_dot.item() == 0
        assert side * push(still(), cart, model, side * 1.01 * breakaway, step=step)[-1].x_dot.item() > 0

    def test_breaks_away_with_a_jump_under_stribeck(self, make_cart: MakeCart) -> None:
        """Once it moves, 0.55 N is more than enough; at rest it is not."""
        cart = make_cart(1, cart_coulomb=0.5, cart_stiction_ratio=1.2, cart_viscous=0.0, **NO_POLE)
        assert push(still(), cart, CART_FRICTIONS.find("stribeck"), 0.55)[-1].x_dot.item() == 0
        assert push(still(0.05), cart, CART_FRICTIONS.find("stribeck"), 0.55)[-1].x_dot.item() > 0.05

    def test_a_stuck_cart_lets_its_pole_swing_as_on_a_wall(self, make_cart: MakeCart) -> None:
        cart = make_cart(1, cart_coulomb=50.0)
        states = push(still(theta=math.pi + 0.02), cart, CART_FRICTIONS.find("step"), seconds=5, step=2e-3)
        assert all(state.x.item() == 0 for state in states)
        angle = torch.cat([state.theta for state in states]) - math.pi
        crossings = ((angle[:-1] > 0) & (angle[1:] <= 0)).nonzero().flatten().to(torch.float64) * 2e-3
        period = (
            2
            * math.pi
            * math.sqrt(cart.pivot_inertia.item() / (cart.pole_mass.item() * GRAVITY * cart.pole_com.item()))
        )
        assert crossings.diff().mean().item() == pytest.approx(period, rel=1e-3)
        assert period == pytest.approx(0.964, abs=0.001)  # Quanser's medium pole


def test_a_small_swing_decays_exponentially(make_cart: MakeCart) -> None:
    """On a cart that does not move: amplitude exp(-b t / (2 J))."""
    cart = make_cart(1, cart_mass=1e9, pole_viscous=1e-3)
    models = Models(
        CART_FRICTIONS.find("none"), POLE_FRICTIONS.find("exponential"), ACTUATORS.find("newtons")
    )
    body, state, angles = mechanism(cart), still(theta=math.pi + 0.05), []
    for _ in range(9500):
        state = advance(state, at(0.0), cart, body, models, 1e-3)
        angles.append(state.theta.item() - math.pi)
    decay = cart.pole_viscous.item() / (2 * cart.pivot_inertia.item())
    for seconds in (3, 6, 9):
        window = angles[round((seconds - 0.5) / 1e-3) : round((seconds + 0.5) / 1e-3)]
        peak = max(range(len(window)), key=window.__getitem__)
        time = seconds - 0.5 + peak * 1e-3
        assert window[peak] == pytest.approx(0.05 * math.exp(-decay * time), rel=5e-3)


def test_drag_shows_at_large_swings_and_bearing_friction_at_small_ones(make_cart: MakeCart) -> None:
    cart = make_cart(1)
    small, large = at(0.1), at(10.0)

    def share_of_drag(speed: Tensor) -> float:
        models = (POLE_FRICTIONS.find("exponential"), POLE_FRICTIONS.find("exponential_drag"))
        viscous, both = (model(speed, cart) for model in models)
        return 1 - (viscous / both).item()

    assert share_of_drag(small) < 0.02
    assert share_of_drag(large) > 0.5


def test_a_pole_that_swings_through_the_bottom_presses_the_cart_onto_the_track(make_cart: MakeCart) -> None:
    cart = make_cart()
    swinging = State(at(0.0), at(0.5), at(math.pi), at(10.0))
    slowed = {}
    for presses in (False, True):
        models = Models(
            CART_FRICTIONS.find("step"),
            POLE_FRICTIONS.find("none"),
            ACTUATORS.find("newtons"),
            pole_presses=presses,
        )
        slowed[presses] = advance(swinging, at(0.0), cart, mechanism(cart), models, 0.01).x_dot.item()
    assert slowed[True] < slowed[False]
