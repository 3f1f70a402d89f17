"""Laws by name: what they read acts, the rest does not; those that cannot be used are refused."""

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import pytest
import torch

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.friction import CART_FRICTIONS, COULOMB, POLE_FRICTIONS, coulomb_force
from cartpole_rl.physics.models import Models, check_laws, unused_parameters
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.rig.parameters import NON_NEGATIVE, PARAMETERS, Parameter

MakeCart = Callable[..., CartParameters]
MODELS = [Models(*laws) for laws in product(CART_FRICTIONS, POLE_FRICTIONS, ACTUATORS)]


def end_state(cart: CartParameters, models: Models) -> torch.Tensor:
    carts = cart.table.shape[1]
    state = State(*(torch.full((carts,), value, dtype=torch.float64) for value in (0.0, 0.3, 2.0, 4.0)))
    motors = torch.tensor([120.0, -180.0], dtype=torch.float64).unsqueeze(1).repeat(1, carts)
    drive = Drive(torch.zeros(carts, dtype=torch.float64), motors)
    latency = torch.full((carts,), 0.005, dtype=torch.float64)
    state, _ = run_period(state, drive, latency, cart, models, 0.02, 4)
    return torch.stack(state)


def changed(make_cart: MakeCart, name: str) -> CartParameters:
    return make_cart(**{name: 1.5 * float(getattr(make_cart(), name)[0]) + 0.01})


@pytest.mark.parametrize("models", MODELS, ids=lambda models: "-".join(models[:3]))
def test_a_parameter_that_no_law_reads_changes_nothing(models: Models, make_cart: MakeCart) -> None:
    reference = end_state(make_cart(), models)
    check_laws(models, make_cart())
    for name in unused_parameters(models):
        assert torch.equal(end_state(changed(make_cart, name), models), reference), name


def test_an_unknown_law_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(
        ConfigError, match=r"'stribek' is unknown: give 'none', .*'stribeck', or your own as mod"
    ):
        Models.of(cart_friction="stribek")


@pytest.mark.usefixtures("own_extensions")
class TestOwnLaws:
    @pytest.fixture
    def registered(self, make_cart: MakeCart) -> Iterator[Callable[..., None]]:
        def build(kind: Any, formula: Callable[..., Any], reads: tuple[Any, ...] = COULOMB) -> None:
            kind.register("own", reads=reads)(formula)
            check_laws(Models.of(**{kind.kind: "own"}), make_cart())

        return build

    def test_one_with_its_own_parameter(self, registered: Callable[..., None], make_cart: MakeCart) -> None:
        drag = Parameter("own_drag", "N s^2/m^2", NON_NEGATIVE, 2.0, None, "drag of the cart in air")

        def formula(x_dot: torch.Tensor, cart: CartParameters) -> torch.Tensor:
            return cart.own_drag * x_dot * x_dot.abs()

        registered(CART_FRICTIONS, formula, (drag,))
        law = CART_FRICTIONS.find("own")
        assert PARAMETERS["own_drag"] == drag
        assert "own_drag" in CartParameters.names()
        assert law(torch.tensor([0.5, -1.0]), make_cart(2, own_drag=3.0)).tolist() == [0.75, -3.0]
        assert "own_drag" in unused_parameters(Models())
        assert "own_drag" not in unused_parameters(Models(cart_friction=law))
        with pytest.raises(ConfigError, match="another cart parameter 'own_drag' already"):
            registered(POLE_FRICTIONS, formula, (drag._replace(default=1.0),))

    @pytest.mark.parametrize(
        ("kind", "formula", "message"),
        [
            (
                CART_FRICTIONS,
                lambda v, cart: -coulomb_force(v, cart) * v.sign(),
                "own drives at -3: friction on",
            ),
            (POLE_FRICTIONS, lambda v, cart: 1e-3 * v, "pole_friction=own drives at"),
            (
                CART_FRICTIONS,
                lambda v, cart: cart.pole_drag * v,
                "own reads pole_drag: add it to its `reads`",
            ),
            (
                CART_FRICTIONS,
                lambda v, cart: coulomb_force(v, cart).sum(),
                "a finite number for each of N carts",
            ),
            (CART_FRICTIONS, lambda v, cart: coulomb_force(v, cart) / v * v, "a finite number for each"),
            (
                CART_FRICTIONS,
                lambda v, cart: cart.mass * v,
                "its formula fails: AttributeError: carts have no par",
            ),
            (CART_FRICTIONS, lambda v: v, "own is no cart friction: it must be a function of two arguments"),
            (ACTUATORS, lambda motor, cart: motor + 1, "actuator=own gives 1 N at motor value 0, not 0"),
        ],
    )
    def test_those_that_cannot_be_used(
        self, registered: Callable[..., None], kind: Any, formula: Callable[..., Any], message: str
    ) -> None:
        with pytest.raises(ConfigError, match=message) as raised:
            registered(kind, formula)
        assert "\n" not in str(raised.value)

    def test_a_name_that_is_no_parameter(self, registered: Callable[..., None]) -> None:
        with pytest.raises(
            ConfigError, match="reads of own: unknown cart parameter 'cart_colomb'; did you mean"
        ):
            registered(CART_FRICTIONS, lambda v, cart: v, ("cart_colomb",))
