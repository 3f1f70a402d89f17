"""Checks that a cart, its poles and their ranges make sense, before anything is drawn."""

from collections.abc import Mapping

from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.rig.parameters import check_names, check_values


def check_carts(cart: Mapping[str, float], poles: PoleSettings, ranges: Mapping[str, Range]) -> None:
    """Raise ConfigError if such carts cannot be drawn.

    Causes: an unknown name, an impossible nominal value, a range that reaches an impossible value, or a
    parameter of the pole in `cart`.
    """
    for name in Pole.model_fields:
        if name in cart:
            raise ConfigError(f"{name} belongs to the pole, not to the cart: choose another pole")
    nominal = {**cart, **poles.nominal.model_dump()}
    check_values(nominal)
    check_names(ranges)
    for name, line in ranges.items():
        for pole in possible_poles(poles):
            line.check(name, {**nominal, **pole.model_dump()}[name])


def possible_poles(poles: PoleSettings) -> list[Pole]:
    """Return the choices; the rod of middle length represents rods of random length."""
    return [poles.nominal] if poles.choices is None else list(poles.choices.values())


def check_one_pole(owner: str, poles: PoleSettings) -> Pole:
    """Return the pole. Raises ConfigError, which names `owner`, if there are several `poles`."""
    if not poles.is_single:
        raise ConfigError(f"pole: {owner} takes one pole, not {poles.name}; choose one, as pole=medium")
    return poles.nominal
