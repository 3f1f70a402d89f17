"""Encoder counts to observations. All tensors are [N] or [k, N]; angles in rad, positions in m.

To add a number to the observation, add a `Quantity`, an `ObservationKind` that lists it, and a choice in
`conf/observation/`. Formulas use methods of tensors alone; settings can import this module without PyTorch.
"""

from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, Self

from cartpole_rl.rig.hardware import LARGEST_MOTOR, Encoders

if TYPE_CHECKING:
    from torch import Tensor

# Each scale is about the largest value in a vigorous swing-up.
POSITION_SCALE = 0.38  # m
SPEED_SCALE = 1.0  # m/s
ANGULAR_SPEED_SCALE = 8.0  # rad/s
MOTOR_SCALE = float(LARGEST_MOTOR)
LENGTH_SCALE = 0.5  # m


class Measured(NamedTuple):
    """The measured state of N carts, [N] each."""

    x: "Tensor"  # m
    x_dot: "Tensor"  # m/s
    theta: "Tensor"  # rad, wrapped
    theta_dot: "Tensor"  # rad/s


def measured_position(counts: "Tensor", encoders: Encoders) -> tuple["Tensor", "Tensor"]:
    """Return (x m, theta rad) of counts [2, N] int64; theta is wrapped as an integer, which is exact."""
    return counts[0] * encoders.metres, wrapped(counts[1], encoders.turn) * encoders.radians


def wrapped(pole: "Tensor", turn: int) -> "Tensor":
    """Return pole counts of any number of turns within half a turn of upright, int64."""
    half_turn = turn // 2
    if turn.bit_count() == 1:  # a power of two, where a mask takes half the time
        return ((pole + half_turn) & (turn - 1)) - half_turn
    return (pole + half_turn) % turn - half_turn


def measured_velocity(
    counts: "Tensor", previous: "Tensor", dt: "Tensor", encoders: Encoders
) -> tuple["Tensor", "Tensor"]:
    """Return (x_dot m/s, theta_dot rad/s): the difference of counts [2, N] divided by `dt` [N] s.

    One count of ip02 in 20 ms is 1.1 mm/s and 0.077 rad/s. The difference is the velocity half a period
    earlier.
    """
    cart, pole = (counts - previous).to(dt.dtype)
    return cart * encoders.metres / dt, pole * encoders.radians / dt


class Quantity(NamedTuple):
    """A number of an observation."""

    formula: Callable[[Measured], "Tensor"]
    mirror_sign: int  # its factor when left and right are swapped
    name: str = ""  # in an exported agent
    unit: str = ""  # of formula * scale
    scale: float = 1.0  # by which the formula divides


X = Quantity(lambda state: state.x / POSITION_SCALE, -1, "x", "m", POSITION_SCALE)
X_DOT = Quantity(lambda state: state.x_dot / SPEED_SCALE, -1, "x_dot", "m/s", SPEED_SCALE)
COSINE = Quantity(lambda state: state.theta.cos(), 1, "cos_theta")
SINE = Quantity(lambda state: state.theta.sin(), -1, "sin_theta")
THETA_DOT = Quantity(
    lambda state: state.theta_dot / ANGULAR_SPEED_SCALE, -1, "theta_dot", "rad/s", ANGULAR_SPEED_SCALE
)
UNSCALED = (
    Quantity(lambda state: state.x, -1, "x", "m"),
    Quantity(lambda state: state.x_dot, -1, "x_dot", "m/s"),
    Quantity(lambda state: state.theta, -1, "theta", "rad"),
    Quantity(lambda state: state.theta_dot, -1, "theta_dot", "rad/s"),
)


class ObservationKind(StrEnum):
    """The form in which the agent observes the measured state. The value of a member is its name."""

    quantities: tuple[Quantity, ...]

    RAW = "raw", UNSCALED  # the thesis's four numbers
    COS_SIN = "cos_sin", (X, X_DOT, COSINE, SINE, THETA_DOT)  # each scaled to about one
    POSITIONS = "positions", (X, COSINE, SINE)  # as cos_sin, without velocities

    def __new__(cls, name: str, quantities: tuple[Quantity, ...]) -> Self:
        """Make a member."""
        member = str.__new__(cls, name)
        member._value_, member.quantities = name, quantities
        return member

    @property
    def size(self) -> int:
        """The number of numbers that `observe` returns."""
        return len(self.quantities)

    @property
    def mirror_signs(self) -> tuple[int, ...]:
        """The factor of each number when left and right are swapped."""
        return tuple(quantity.mirror_sign for quantity in self.quantities)


def observe(state: Measured, kind: ObservationKind) -> tuple["Tensor", ...]:
    """Return the numbers of an observation, [N] each."""
    return tuple(quantity.formula(state) for quantity in kind.quantities)
