"""The parameters of a batch of carts: names, bounds, derived quantities."""

from collections.abc import Callable

import pytest
import torch

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.models import REGISTRIES
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.rig.parameters import PARAMETERS, check_values

MakeCart = Callable[..., CartParameters]


def test_the_table_is_complete(nominal: dict[str, float]) -> None:
    assert CartParameters.names() == tuple(PARAMETERS)
    assert set(nominal) <= set(PARAMETERS)
    check_values(nominal)
    for each in PARAMETERS.values():
        assert each.unit
        assert each.meaning
        assert each.default is None or each.bound.holds(each.default)
    read = {name for registry in REGISTRIES.values() for law in registry for name in law.reads}
    assert {name for name in PARAMETERS if name.startswith(("force", "deadband", "pole_v", "cart_v"))} <= read


def test_a_cart_has_the_defaults_of_what_it_lacks(nominal: dict[str, float]) -> None:
    needed = {name: value for name, value in nominal.items() if PARAMETERS[name].default is None}
    check_values(needed)
    cart = CartParameters(cart_column(needed))
    assert cart.cart_stiction_ratio.item() == 1.0
    assert cart.track_tilt.item() == 0.0


def test_derived_quantities(make_cart: MakeCart) -> None:
    cart = make_cart(2, cart_mass=0.7, pole_mass=0.2, pole_com=0.25, pole_inertia=0.004)
    torch.testing.assert_close(cart.total_mass, torch.full((2,), 0.9, dtype=torch.float64))
    torch.testing.assert_close(cart.first_moment, torch.full((2,), 0.05, dtype=torch.float64))
    torch.testing.assert_close(cart.pivot_inertia, torch.full((2,), 0.0165, dtype=torch.float64))
    torch.testing.assert_close(cart.pole_length, torch.full((2,), 0.5, dtype=torch.float64))


def test_fields_share_the_tables_memory_and_cannot_be_set() -> None:
    table = torch.rand(len(PARAMETERS), 3)
    cart = CartParameters(table)
    copied = cart.clone()
    table[CartParameters.names().index("latency"), 1] = 7.0
    assert cart.latency[1] == 7.0
    assert copied.latency[1] < 1
    with pytest.raises(AttributeError, match="cannot be set"):
        cart.latency = torch.zeros(3)
    with pytest.raises(AttributeError, match="no parameter 'lag'"):
        _ = cart.lag


def test_a_missing_value_is_named(nominal: dict[str, float]) -> None:
    lacking = {name: value for name, value in nominal.items() if name != "latency"}
    with pytest.raises(ConfigError, match="'latency' is missing"):
        check_values(lacking)


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
