"""One finished episode as arrays, for scores, figures and recordings, and the reasons of its ending.

The plant reports track, fault and link; angle and time belong to the task. Upright is defined here too: the
angle of score (6.2), and how long it has to be held.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.rig.hardware import Encoders, nominal_encoders
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE
from cartpole_rl.tasks.settings import Measure

Array = NDArray[np.float64]
IRREGULAR = 0.2  # share of the period that a frame may come early or late
HOLD = 1.0  # s that the pole has to stay upright


class Ending(StrEnum):
    """The reasons of ending in metrics.json and recordings."""

    TIME = "time"  # truncated: the time limit
    ANGLE = "angle"  # terminated: the balance task's pole fell
    TRACK = "track"  # terminated: the cart left the track
    FAULT = "fault"  # truncated: the cart latched a fault, or a count froze or jumped
    LINK = "link"  # truncated: the cart stopped answering
    NON_FINITE = "non_finite"  # truncated: an observation or an action value was not finite


@dataclass(frozen=True)
class Origin:
    """A simulated cart and the true initial state of an episode: enough to repeat it."""

    parameters: Mapping[str, float]  # of cart and pole, by name
    state: Mapping[str, float]  # x m, x_dot m/s, theta rad, theta_dot rad/s


@dataclass(frozen=True)
class Episode:
    """One episode of T control periods, as measured by the cart.

    Row t of the state is measured before `motor[t]` is chosen; the last row is where the episode ended.
    """

    time: Array  # [T+1] s, from 0, by the cart's clock
    x: Array  # [T+1] m, positive to the right
    x_dot: Array  # [T+1] m/s
    theta: Array  # [T+1] rad, 0 upright, positive to the right, not wrapped
    theta_dot: Array  # [T+1] rad/s
    counts: NDArray[np.int64]  # [T+1, 2] encoder counts of cart and pole, as the cart sent them
    motor: NDArray[np.int64]  # [T] motor value sent, -255 to 255; reported, where the cart's board drove
    score: Array  # [T] equation (6.2) of each step, at state t+1
    score_upright: Array  # [T] equation (6.1) of each step, at state t+1
    reward: Array  # [T]
    ended_by: str  # an `Ending`
    origin: Origin | None = None  # None on a real cart
    # [T] the track guard replaced the agent's motor value; None without one
    guarded: NDArray[np.bool_] | None = None
    # [T] motor value that this computer would have sent, where a policy on the cart's board drove
    expected: NDArray[np.int64] | None = None
    # [T] the motor value can be compared with `expected`; None unless the cart's board drove
    compared: NDArray[np.bool_] | None = None
    left_out: str = ""  # control periods after the last row that do not count, and why
    encoders: Encoders = nominal_encoders()  # noqa: RUF009 - it is a tuple
    # motor values before the first one, oldest first, where they are known
    motor_before: tuple[int, ...] = ()

    @property
    def positions(self) -> Array:
        """Return cart and pole as the encoders measured them, [T+1, 2], m and rad."""
        return self.counts * np.array(self.encoders.resolution)

    @property
    def pole_length(self) -> float | None:
        """The length of a uniform rod with its pole's centre of mass, m; None where that is not known."""
        return 2 * self.origin.parameters["pole_com"] if self.origin else None

    @property
    def measured_steps(self) -> int:
        """Number of control periods whose outcome was measured: all but the last one before a lost link."""
        return self.steps - (self.ended_by == "link")

    def regular_frames(self, period: float) -> NDArray[np.bool_]:
        """Return for each control period of `period` s, [T], whether the frame at its end came in time."""
        return np.abs(np.diff(self.time) / period - 1) < IRREGULAR

    def part(self, first: int, last: int) -> "Episode":
        """Return the control periods from `first` up to, and without, `last`."""
        arrays: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        before = (*self.motor_before, *self.motor[:first].tolist())
        cut = {
            name: array[first : last + len(array) - self.steps]
            for name, array in arrays.items()
            if hasattr(array, "dtype")
        }
        return replace(self, motor_before=before, **cut)

    def total(self, measure: Measure) -> float:
        """Return the sum of (6.2) or of (6.1) over the episode."""
        return float(self.score.sum() if measure == "score" else self.score_upright.sum())

    @property
    def steps(self) -> int:
        """Number of control periods."""
        return len(self.motor)


def wrap(theta: Array) -> Array:
    """Return angles in rad, of any shape, wrapped to (-pi, pi]."""
    return -((-theta + math.pi) % (2 * math.pi) - math.pi)


def is_upright(theta: Array) -> NDArray[np.bool_]:
    """Return True for each angle (rad, wrapped or not) within 5 degrees of upright."""
    return np.abs(wrap(theta)) < UPRIGHT_ANGLE


def upright_at_end(time: Array, theta: Array) -> bool:
    """Return True if the pole is upright during the whole last second (`HOLD`).

    `time` [T] in s, ascending; `theta` [T] in rad.
    """
    last = time >= time[-1] - HOLD
    return bool(time[-1] - time[0] >= HOLD and is_upright(theta[last]).all())


def standing(time: Array, theta: Array) -> list[tuple[int, int]]:
    """Return the first and the last index of each stretch in which the pole is upright for a second (`HOLD`).

    `time` [T] in s, ascending; `theta` [T] in rad.
    """
    edges = np.flatnonzero(np.diff(np.pad(is_upright(theta).astype(int), 1))).reshape(-1, 2)
    return [(first, end - 1) for first, end in edges.tolist() if time[end - 1] - time[first] >= HOLD]


class Fall(NamedTuple):
    """A fall below the horizontal of a pole that had stood for a second (`HOLD`)."""

    moment: float  # s, at which it was last upright
    recovery: float | None  # s from then until it stands for a second again; None if it does not
    swings: int  # how often it passes the hanging position in this time, or until the end of the episode


def falls(time: Array, theta: Array) -> list[Fall]:
    """Return the falls of an episode in their order. `time` [T] in s, ascending; `theta` [T] in rad.

    An episode may end with an angle that is not finite.
    """
    stood = standing(time, theta)
    turns = np.floor((np.unwrap(theta) + math.pi) / (2 * math.pi))  # changes by 1 at the hanging position
    found = []
    for (_, last), (first, _) in pairwise([*stood, (len(time), len(time))]):
        if (np.cos(theta[last:first]) < 0).any():
            recovery = float(time[first] - time[last]) if first < len(time) else None
            swings = int(np.nansum(np.abs(np.diff(turns[last:first]))))
            found.append(Fall(float(time[last]), recovery, swings))
    return found


def upright_since(time: Array, theta: Array) -> float | None:
    """Return the first time (s) from which the pole stays upright for one second; None if it never does.

    `time` [T] in s, ascending; `theta` [T] in rad.
    """
    return next((float(time[first]) for first, _ in standing(time, theta)), None)
