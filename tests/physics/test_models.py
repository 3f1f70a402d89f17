"""The parameters of `unused_parameters` have no effect; others have."""

import pytest
import torch

from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.models import Models, unused_parameters
from cartpole_rl.physics.parameters import CartParameters

MODELS = [
    Models(cart, pole, actuator)
    for cart in CART_FRICTIONS
    for pole in POLE_FRICTIONS
    for actuator in ACTUATORS
]


def end_state(cart: CartParameters, models: Models) -> torch.Tensor:
    carts = cart.table.shape[1]
    state = State(*(torch.full((carts,), value, dtype=torch.float64) for value in (0.0, 0.3, 2.0, 4.0)))
    motors = torch.tensor([120.0, -180.0], dtype=torch.float64).unsqueeze(1).repeat(1, carts)
    drive = Drive(torch.zeros(carts, dtype=torch.float64), motors)
    latency = torch.full((carts,), 0.005, dtype=torch.float64)
    state, _ = run_period(state, drive, latency, cart, models, 0.02, 4)
    return torch.stack(state)


@pytest.mark.parametrize("models", MODELS, ids=lambda models: "-".join(models[:3]))
def test_a_parameter_that_is_named_changes_nothing(models: Models, make_cart) -> None:
    reference = end_state(make_cart(), models)
    for name in unused_parameters(models):
        changed = make_cart(**{name: 1.5 * float(getattr(make_cart(), name)[0]) + 0.01})
        assert torch.equal(end_state(changed, models), reference), name


@pytest.mark.parametrize(
    ("name", "models"),
    [
        ("cart_coulomb", Models(cart_friction=CART_FRICTIONS.find("step"))),
        ("cart_viscous", Models(cart_friction=CART_FRICTIONS.find("linear"))),
        ("sigmoid_slope", Models(cart_friction=CART_FRICTIONS.find("sigmoid"))),
        ("pole_drag", Models(pole_friction=POLE_FRICTIONS.find("exponential_drag"))),
        ("pole_coulomb", Models(pole_friction=POLE_FRICTIONS.find("bearing"))),
        ("force_linear", Models(actuator=ACTUATORS.find("force_curve"))),
    ],
)
def test_a_parameter_that_is_not_named_acts(name: str, models: Models, make_cart) -> None:
    assert name not in unused_parameters(models)
    changed = make_cart(**{name: 1.5 * float(getattr(make_cart(), name)[0]) + 0.01})
    assert not torch.equal(end_state(changed, models), end_state(make_cart(), models))
