"""Effects of integrators and friction models on the energy."""

import math
from collections.abc import Callable
from itertools import product

import pytest
import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import State, advance, mechanism
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import INTEGRATORS, Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters

MakeCart = Callable[..., CartParameters]
FRICTIONLESS = Models.of(cart_friction="none", pole_friction="none", actuator="newtons")
EXPLICIT = FRICTIONLESS._replace(integrator=INTEGRATORS.find("explicit"))


def random_states(count: int) -> State:
    generator = torch.Generator().manual_seed(0)
    unit = 2 * torch.rand((count, 4), generator=generator, dtype=torch.float64) - 1
    return State(*(unit * torch.tensor([0.2, 0.5, math.pi, 6.0], dtype=torch.float64)).unbind(1))


def coast(state: State, cart: CartParameters, models: Models, step: float, seconds: float) -> list[State]:
    """Return the states of an undriven cart, the first one included."""
    body, no_force, states = mechanism(cart), torch.zeros_like(state.x), [state]
    for _ in range(round(seconds / step)):
        states.append(advance(states[-1], no_force, cart, body, models, step))
    return states


def energy(state: State, cart: CartParameters) -> Tensor:
    """Return kinetic and potential energy, J, [N]; 0 for a cart at rest in the middle with the pole level."""
    angle = state.theta - cart.track_tilt
    kinetic = (
        0.5 * cart.total_mass * state.x_dot**2
        + cart.first_moment * state.x_dot * state.theta_dot * torch.cos(angle)
        + 0.5 * cart.pivot_inertia * state.theta_dot**2
    )
    height = cart.first_moment * GRAVITY * torch.cos(state.theta)
    slope = -cart.total_mass * GRAVITY * state.x * torch.sin(cart.track_tilt)
    return kinetic + height + slope


def energies(states: list[State], cart: CartParameters) -> Tensor:
    """[T, N], J."""
    return torch.stack([energy(state, cart) for state in states])


class TestIntegrators:
    def swings(self, make_cart: MakeCart) -> tuple[State, CartParameters]:
        """Swings about hanging, without horizontal momentum."""
        state, cart = random_states(64), make_cart(64)
        share = cart.first_moment / cart.total_mass
        state = state._replace(x_dot=-share * torch.cos(state.theta) * state.theta_dot)
        below_the_top = energy(state, cart) < 0.8 * energy(State(*torch.zeros(4, 64).unbind()), cart)
        count = int(below_the_top.sum())
        assert count > 30
        return State(*(value[below_the_top] for value in state)), make_cart(count)

    @pytest.mark.parametrize(("step", "bound"), [(0.02, 0.1), (0.01, 0.05), (0.005, 0.025)])
    def test_semi_implicit_drift_is_bounded_and_falls_with_the_step(
        self, make_cart: MakeCart, step: float, bound: float
    ) -> None:
        """Over 10 s; the pole has 0.22 J upright, -0.22 J hanging. The energy drifts down, not up."""
        state, cart = self.swings(make_cart)
        drift = energies(coast(state, cart, FRICTIONLESS, step, 10), cart) - energy(state, cart)
        assert drift.abs().max() < bound
        assert drift.max() < 0.4 * bound

    def test_a_hanging_pole_reaches_the_top_only_with_explicit_euler(self, make_cart: MakeCart) -> None:
        """Thesis 3.1.3. It starts 3 degrees from hanging, at rest, at the control period of 0.02 s."""
        cart, zero = make_cart(), torch.zeros(1, dtype=torch.float64)
        start = State(zero, zero, zero + math.pi + 0.05, zero)
        farthest = {
            models.integrator: max(
                abs(state.theta.item() - math.pi) for state in coast(start, cart, models, 0.02, 20)
            )
            for models in (FRICTIONLESS, EXPLICIT)
        }
        assert farthest["explicit"] > math.pi
        assert farthest["semi_implicit"] == pytest.approx(0.05, rel=0.01)


POLES = [
    {"pole_friction": "none"},
    {"pole_friction": "exponential"},
    {"pole_friction": "exponential_drag", "pole_presses": True},
]


@pytest.mark.parametrize(("step", "seconds"), [(0.02, 6), (0.002, 0.6)])
def test_a_coasting_cart_never_gains_energy(make_cart: MakeCart, step: float, seconds: float) -> None:
    """Up to the integration error: 1.5 times that of the same start without friction."""
    cart, start = make_cart(64), random_states(64)
    frictionless = energies(coast(start, cart, FRICTIONLESS, step, seconds), cart)
    error = frictionless.max(0).values - frictionless.min(0).values
    for friction, pole in product(CART_FRICTIONS, POLES):
        models = Models.of(cart_friction=friction, actuator="newtons", **pole)
        if models == FRICTIONLESS:
            continue
        course = energies(coast(start, cart, models, step, seconds), cart)
        rise = (course - torch.cummin(course, 0).values).max(0).values
        assert (rise <= 1.5 * error).all(), models
        assert course[-1].mean() < frictionless[-1].mean(), models


@pytest.mark.parametrize("law", ["step", "stribeck"])
@pytest.mark.parametrize("step", [0.02, 0.002])
def test_sticking_friction_takes_kinetic_energy_out_of_every_single_step(
    make_cart: MakeCart, law: str, step: float
) -> None:
    """Exactly: kinetic energy after the step is at most that without friction, at the same configuration."""
    cart, start = make_cart(4000, cart_viscous=0.0), random_states(4000)
    slow = start._replace(x_dot=0.02 * start.x_dot)  # where the cart stops or turns within the step
    for state in (start, slow):
        (_, free), (_, rubbed) = (
            coast(state, cart, FRICTIONLESS._replace(cart_friction=CART_FRICTIONS.find(name)), step, step)
            for name in ("none", law)
        )
        before, after = (
            energy(state._replace(x_dot=end.x_dot, theta_dot=end.theta_dot), cart) for end in (free, rubbed)
        )
        assert (after <= before + 1e-15).all()
        assert (after < before - 1e-6).any()
