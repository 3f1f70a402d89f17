"""Carts drawn from a table of carts keep the parameters of a cart together; some come from the prior."""

from collections.abc import Callable

import pytest
import torch

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import Range

MASS, VISCOUS = (CartParameters.names().index(name) for name in ("cart_mass", "cart_viscous"))


def identified_carts(ip02: dict[str, float], medium: PoleSettings, prior_share: float) -> IdentifiedCarts:
    prior = Randomizer(ip02, medium, {"cart_mass": Range(absolute=(5.0, 6.0))})
    table = prior.nominal.unsqueeze(1).repeat(1, 100)
    table[MASS] = torch.linspace(0.5, 1.0, 100)
    table[VISCOUS] = 2 * table[MASS]
    return IdentifiedCarts(table, prior, prior_share, longest_delay=0.03)


def test_rows_stay_together(ip02: dict[str, float], medium: PoleSettings) -> None:
    drawn = identified_carts(ip02, medium, 0.0).draw(500, torch.Generator().manual_seed(0))
    assert torch.equal(drawn[VISCOUS], 2 * drawn[MASS])
    assert len(drawn[MASS].unique()) > 50


def test_a_number_that_is_not_finite_is_refused(ip02: dict[str, float], medium: PoleSettings) -> None:
    prior = Randomizer(ip02, medium, {})
    table = prior.nominal.unsqueeze(1).repeat(1, 100)
    table[VISCOUS, 7] = float("nan")
    with pytest.raises(ConfigError, match="cart_viscous is not finite"):
        IdentifiedCarts(table, prior, 0.0, longest_delay=0.03)


def test_the_share_of_the_prior(ip02: dict[str, float], medium: PoleSettings) -> None:
    drawn = identified_carts(ip02, medium, 0.2).draw(5000, torch.Generator().manual_seed(0))
    assert 0.17 < (drawn[MASS] >= 5).float().mean() < 0.23


def test_a_plant_goes_on_with_other_carts(
    ip02: dict[str, float], medium: PoleSettings, make_plant: Callable[..., SimulatedPlant]
) -> None:
    plant = make_plant(8)
    plant.replace_randomizer(identified_carts(ip02, medium, 0.0))
    plant.reset()
    assert torch.equal(plant.parameters.cart_viscous, 2 * plant.parameters.cart_mass)
    assert identified_carts(ip02, medium, 0.0).longest_delay() == 0.03
