"""The parameters of a batch of carts: names, bounds, derived quantities."""

from collections.abc import Callable

import pytest
import torch

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import POLE_DENSITY, PoleSettings, uniform_rod
from cartpole_rl.rig.parameters import PARAMETERS, check_names, check_values

MakeCart = Callable[..., CartParameters]


@pytest.fixture
def nominal(ip02: dict[str, float], medium: PoleSettings) -> dict[str, float]:
    return {**ip02, **medium.nominal.model_dump()}


def test_every_parameter_has_bounds_and_a_nominal_value(nominal: dict[str, float]) -> None:
    assert set(CartParameters.names()) == set(PARAMETERS) == set(nominal)
    check_values(nominal)


def test_derived_quantities(make_cart: MakeCart) -> None:
    cart = make_cart(2, cart_mass=0.7, pole_mass=0.2, pole_com=0.25, pole_inertia=0.004)
    torch.testing.assert_close(cart.total_mass, torch.full((2,), 0.9, dtype=torch.float64))
    torch.testing.assert_close(cart.first_moment, torch.full((2,), 0.05, dtype=torch.float64))
    torch.testing.assert_close(cart.pivot_inertia, torch.full((2,), 0.0165, dtype=torch.float64))
    torch.testing.assert_close(cart.pole_length, torch.full((2,), 0.5, dtype=torch.float64))


def test_fields_share_the_tables_memory_and_cannot_be_set() -> None:
    table = torch.rand(len(PARAMETERS), 3)
    cart = CartParameters.from_table(table)
    table[CartParameters.names().index("latency"), 1] = 7.0
    assert cart.latency[1] == 7.0
    with pytest.raises(AttributeError):
        cart.latency = torch.zeros(3)


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(ConfigError, match="'cart_colomb'; did you mean 'cart_coulomb'"):
        check_names(["cart_mass", "cart_colomb"])


def test_a_missing_value_is_named(nominal: dict[str, float]) -> None:
    del nominal["latency"]
    with pytest.raises(ConfigError, match="'latency' is missing"):
        check_values(nominal)


@pytest.mark.parametrize(
    ("name", "value", "right"),
    [
        ("cart_mass", -0.1, "above 0"),
        ("pole_com", 0.0, "above 0"),
        ("pole_inertia", -1e-6, "at least 0"),
        ("cart_stiction_ratio", 0.9, "at least 1"),
        ("deadband_left", 256.0, "at least 0 and at most 255"),
        ("latency", 0.2, "at least 0 and at most 0.1"),
        ("force_asymmetry", -1.0, "at least -0.99 and at most 0.99"),
        ("pole_viscous", float("nan"), "at least 0"),
    ],
)
def test_an_impossible_value_is_refused(
    nominal: dict[str, float], name: str, value: float, right: str
) -> None:
    with pytest.raises(ConfigError, match=f"{name} is .*; it must be {right}"):
        check_values({**nominal, name: value})


def test_a_rod_is_consistent() -> None:
    rod = uniform_rod(0.6)
    assert rod["pole_mass"] == pytest.approx(POLE_DENSITY * 0.6)
    assert rod["pole_com"] == pytest.approx(0.3)
    about_pivot = rod["pole_inertia"] + rod["pole_mass"] * rod["pole_com"] ** 2
    assert about_pivot == pytest.approx(rod["pole_mass"] * 0.6**2 / 3)
