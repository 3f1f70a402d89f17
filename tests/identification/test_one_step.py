"""One-step regression finds exact numbers from exact transitions, and only from those."""

import numpy as np
import pytest
import torch

from cartpole_rl.choices import choice
from cartpole_rl.identification.one_step import FRICTION_AND_FORCE, MASSES, Transitions, predicted, regression
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models

PERIOD = 0.02
MODELS = Models(cart_friction=CART_FRICTIONS.find("step"))
NOMINAL = choice("cart/ip02") | choice("pole/medium")["choices"]["medium"]
TRUTH = {
    **NOMINAL,
    "cart_mass": 0.85,
    "pole_mass": 0.15,
    "pole_com": 0.2,
    "cart_coulomb": 0.6,
    "pole_viscous": 5e-4,
    "force_quadratic": 4e-6,
    "force_linear": 0.018,
    "force_offset": -0.9,
}


def exact() -> Transitions:
    random = np.random.default_rng(0)
    states = random.uniform(-1, 1, (4, 400)) * np.array([[0.3], [0.8], [3.0], [8.0]])
    motor = torch.from_numpy(random.choice([-250.0, -150.0, 150.0, 200.0, 250.0], 400))
    data = Transitions(motor, torch.from_numpy(states), torch.zeros(4, 400))
    return data._replace(after=predicted(data, TRUTH, MODELS, PERIOD))


@pytest.mark.parametrize("names", [MASSES, FRICTION_AND_FORCE])
def test_exact_transitions_give_the_true_numbers(names: tuple[str, ...]) -> None:
    others = {name: TRUTH[name] for name in TRUTH if name not in names}
    found = regression(exact(), {**NOMINAL, **others}, MODELS, PERIOD, names)
    for name, estimate in found.items():
        assert estimate.value == pytest.approx(TRUTH[name], rel=1e-3), name
