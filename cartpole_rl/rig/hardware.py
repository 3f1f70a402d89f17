"""Encoders, track and motor of a cart, and the rough numbers that its firmware homes and brakes by.

They stand in the cart's file (`conf/cart/` or a person's own) beside the parameters of its motion. The
simulator, the host, recordings, exported agents, the emulated cart and the firmware read them from there. A
cart without one of them has that of ip02.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator

from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Finite, NonNegative, Positive, Settings

LARGEST_MOTOR = 255  # motor value in size, to the left (negative) and to the right


class Encoders(NamedTuple):
    """The scales of the two encoders. Counts are positive to the right."""

    metres: float  # of the cart a count
    turn: int  # counts of the pole a turn

    @property
    def radians(self) -> float:
        """Of the pole a count."""
        return 2 * math.pi / self.turn

    @property
    def resolution(self) -> tuple[float, float]:
        """Cart (m) and pole (rad) a count."""
        return self.metres, self.radians

    @property
    def text(self) -> str:
        """The scales for a message."""
        return f"{1e9 * self.metres:.0f} nm and 1/{self.turn} turn a count"

    def cart_counts(self, metres: float) -> int:
        """Return a distance of the cart in counts."""
        return round(metres / self.metres)

    def pole_counts(self, degrees: float) -> int:
        """Return an angle of the pole in counts."""
        return round(degrees / 360 * self.turn)


class Hardware(Settings):
    """The numbers of a rig that no simulated cart varies. The cart's INFO reports the first five."""

    cart_nanometres_per_count: Annotated[int, Field(ge=1_000, le=1_000_000)]  # nm
    pole_counts_per_turn: Annotated[int, Field(ge=200, le=65_535)]  # 16 bits of INFO
    track_span: Annotated[float, Field(ge=0.15, le=10)]  # m, from stop to stop
    soft_limit: Annotated[float, Field(ge=0.003, le=1)]  # m inside a stop: outward motor values give 0
    hard_limit: Annotated[float, Field(ge=0.001, le=1)]  # m inside a stop: the cart is faulted
    braking: Annotated[float, Field(ge=0.2, le=50)]  # m/s^2: full motor inward slows the cart at least so
    hard_push: Annotated[int, Field(ge=1, le=LARGEST_MOTOR)]  # motor value that moves any healthy cart
    moving_mass: Positive  # kg, cart and pole
    moving_friction: NonNegative  # N
    motor_offset: Annotated[float, Field(ge=0, le=LARGEST_MOTOR)]  # motor value at which the force starts
    motor_per_newton: Positive
    gentle_force: Positive  # N, the largest of homing
    left_switch: Annotated[int, Field(ge=0, le=1)]  # 1: a switch marks that end of `track_span`, not a stop
    right_switch: Annotated[int, Field(ge=0, le=1)]

    @model_validator(mode="after")
    def _limits_lie_on_the_track(self) -> Self:
        if not self.hard_limit < self.soft_limit < self.track_span / 4:
            raise ValueError(
                f"hard_limit {self.hard_limit:g} m and soft_limit {self.soft_limit:g} m are distances from a "
                f"stop; give hard_limit < soft_limit < {self.track_span / 4:g} m, a quarter of track_span"
            )
        if self.encoders.cart_counts(self.soft_limit) <= self.encoders.cart_counts(self.hard_limit):
            raise ValueError(
                f"hard_limit {self.hard_limit:g} m and soft_limit {self.soft_limit:g} m are the same count; "
                f"give limits that are more than {self.encoders.metres:g} m apart"
            )
        return self

    @model_validator(mode="after")
    def _motor_reaches_the_gentle_force(self) -> Self:
        if self.gentle_motor > LARGEST_MOTOR:
            most = (LARGEST_MOTOR - self.motor_offset) / self.motor_per_newton
            raise ValueError(
                f"gentle_force {self.gentle_force:g} N needs a motor value of {self.gentle_motor} by "
                f"motor_offset and motor_per_newton; give at most {most:.3g} N"
            )
        if self.gentle_force <= self.moving_friction:
            raise ValueError(
                f"gentle_force {self.gentle_force:g} N does not overcome moving_friction; give more than "
                f"{self.moving_friction:g} N"
            )
        return self

    @property
    def encoders(self) -> Encoders:
        """The scales of the encoders."""
        return Encoders(self.cart_nanometres_per_count / 1e9, self.pole_counts_per_turn)

    @property
    def scales_text(self) -> str:
        """The scales of the encoders and the length of the track, for messages."""
        return f"{self.encoders.text}, {self.track_span:g} m of track"

    @property
    def half_span(self) -> float:
        """Middle of the track to a stop, m."""
        return self.track_span / 2

    @property
    def switches(self) -> int:
        """The end switches that the rig has, as bits: 1 left, 2 right."""
        return self.left_switch + 2 * self.right_switch

    @property
    def breakaway_motor(self) -> float:
        """The motor value that just moves the cart, by `moving_friction`."""
        return self.motor_offset + self.motor_per_newton * self.moving_friction

    @property
    def gentle_motor(self) -> int:
        """The motor value of `gentle_force`."""
        return int(self.motor_offset + self.motor_per_newton * self.gentle_force)


HARDWARE = tuple(Hardware.model_fields)


def parameters_of(cart: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers of a cart's file that are parameters of its motion."""
    return {name: value for name, value in cart.items() if name not in HARDWARE}


def hardware_of(cart: Mapping[str, float]) -> Hardware:
    """Return the hardware in a cart's file, ip02's where it gives none. Raises ConfigError."""
    given = {name: cart[name] for name in HARDWARE if name in cart}
    return nominal_hardware() if not given else _hardware(tuple(given.items()))


def check_track(cart: Mapping[str, float]) -> None:
    """Raise ConfigError if the track of a cart's file reaches beyond its stops."""
    hardware = hardware_of(cart)
    end, stop = cart.get("track_half_length", 0.0), hardware.half_span
    if end > stop:
        raise ConfigError(
            f"cart.track_half_length is {end:g} m, but the stops are {stop:g} m from the middle by "
            f"track_span; give at most {stop - hardware.soft_limit:g} m, up to the soft limit"
        )


@cache
def _hardware(given: tuple[tuple[str, float], ...]) -> Hardware:
    try:
        return Hardware.model_validate({**_of_ip02(), **dict(given)})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(("cart", *map(str, first["loc"])))
        text = first["msg"].removeprefix("Value error, ")
        given = first["input"]
        number = f" is {given:g}" if isinstance(given, int | float) else f" is {given!r}"
        number = number if first["loc"] else ""
        raise ConfigError(f"{name}{number}: {text[0].lower()}{text[1:]}") from None


@cache
def _of_ip02() -> dict[str, float]:
    cart = choice("cart/ip02")
    return {name: cart[name] for name in HARDWARE}


@cache
def nominal_hardware() -> Hardware:
    """Return the hardware of ip02."""
    return Hardware.model_validate(_of_ip02())


def nominal_encoders() -> Encoders:
    """Return the encoders of ip02."""
    return nominal_hardware().encoders


class RigSettings(Settings):
    """A cart's file: parameters of its motion, and its hardware."""

    cart: dict[str, Finite]

    @model_validator(mode="after")
    def _hardware_is_possible(self) -> Self:
        try:
            hardware_of(self.cart)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def hardware(self) -> Hardware:
        """The encoders, track and motor of the cart."""
        return hardware_of(self.cart)
