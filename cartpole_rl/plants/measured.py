"""The part of an episode that both encoders measured.

A frozen count, or one that jumps, is not the state of any cart: nothing may score it, record it or learn from
it. A cart detects both (docs/protocol.md, rule 3), but a frozen count only after it has been reported for a
while, and an episode may end before. The same rules are applied here to whole episodes, and two more: nothing
stops dead, and no pole balances on a standing cart.
"""

import logging
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.emulator import guards
from cartpole_rl.rig.hardware import Hardware, nominal_hardware
from cartpole_rl.tasks.episode import Array, Ending, Episode, wrap
from cartpole_rl.wire.messages import Fault

LOGGER = logging.getLogger(__name__)

FASTEST_CART = guards.FASTEST_CART / 1e9  # m/s: no cart is faster
FASTEST = FASTEST_CART, guards.FASTEST_POLE  # m/s of the cart, turns/s of the pole
PUSHED = 0.1 - 1e-6  # s of hard pushes in each direction
SPEED_CHANGE = guards.SPEED_CHANGE / 1e6  # m/s up and down that turn any pole
SUDDEN_CART = 0.25  # m/s: from here to standing exactly still
SUDDEN = SUDDEN_CART, 0.05  # m/s, turns/s: a dead stop,
FINE = 2000  # counts a turn: a pole that is balanced may stay within one coarser count
STILL = 0.5  # s, if the count does not change for as long after it
LEANING = 0.025 + 0.008  # rad: largest error of the encoder's zero, and what friction holds
FALLEN = np.radians(10)  # rad: near enough to upright
BLIND, LATE = 0.015, 3  # m that a cart has moved by its file while its count stood, for more periods
HALF = 0.5  # s, over which a pole of up to 1.4 m multiplies its angle by 2.7 or more
FROZEN = "the cart's count froze"
LATCHED = Fault.CART_ENCODER | Fault.STALL, Fault.POLE_ENCODER  # a dead cart encoder can show as a STALL


def measured_part(episode: Episode, fault: Fault = Fault.NONE, hardware: Hardware | None = None) -> Episode:
    """Return the episode up to the last state before a count froze or jumped; log what is left out.

    `fault` are the faults that the cart has latched, `hardware` is its own, ip02's if it is not given. A
    shortened episode ends by a fault, whatever ended it. It has no step if the count never changed in it.
    """
    hardware = hardware or nominal_hardware()
    per_unit = np.array([1 / hardware.encoders.metres, float(hardware.encoders.turn)])  # counts
    end = episode.measured_steps
    counts, gaps = episode.counts[: end + 1], np.diff(episode.time[: end + 1])
    jumps = (np.abs(np.diff(counts, axis=0)) - 1 > FASTEST * per_unit * gaps[:, None]).any(1)
    steps, why = end, ""
    if jumps.any():
        steps, why = int(np.argmax(jumps)), "a count jumped"
    motor, cart = episode.motor[:steps], counts[: steps + 1, 0]
    speed = np.diff(cart) * hardware.encoders.metres / gaps[:steps]
    columns = zip(("cart", "pole"), counts[: steps + 1].T, LATCHED, SUDDEN * per_unit, strict=True)
    for name, own, faults, sudden in columns:
        last = last_change(own, open_wire=name == "cart" or hardware.pole_counts_per_turn >= FINE)
        if name == "cart":
            frozen = cart_froze(motor, gaps, last, hardware.hard_push) or balanced(
                episode.theta[last : steps + 1], gaps
            )
        else:
            frozen = pole_froze(speed[max(0, last - 1) :])
        frozen |= stopped_dead(own, gaps, last, sudden)
        if (frozen or (fault & faults and not jumps.any())) and last < steps:
            steps, why = last, FROZEN if name == "cart" else "the pole's count froze"
    if steps == end and fault & (Fault.CART_ENCODER | Fault.POLE_ENCODER):
        steps, why = max(0, end - 1), "a count jumped"  # lost states may hide the jump
    return episode if steps == end else shortened(episode, steps, why)


class BlindMotion:
    """Notices that a cart's count stands although the motor must have moved the cart.

    A cart's own rules know nothing of motor values below `hard_push`, but they can drive it into its stops.
    """

    def __init__(self, hardware: Hardware, breakaway: float) -> None:
        """`breakaway` is a motor value that surely moves the cart from rest."""
        self._breakaway = breakaway
        self._acceleration = 1 / (hardware.motor_per_newton * hardware.moving_mass)  # m/s^2 a motor value
        self._count: int | None = None
        self._speed = self._way = 0.0  # m/s, m: estimated since the count stands
        self.periods = 0  # for which it stands

    def is_seen(self, motor: int, count: int, passed: float) -> bool:
        """Return True if the cart must have moved under its last motor values, which lasted `passed` s each.

        `count` is that of the cart after them. To and fro by one is no change of it.
        """
        if self._count is None or abs(count - self._count) > 1:
            self._count, self._speed, self._way, self.periods = count, 0.0, 0.0, 0
        push = max(0.0, abs(motor) - self._breakaway)
        self._speed += math.copysign(push, motor) * self._acceleration * passed
        if not push:
            self._speed = 0.0
        self._way += self._speed * passed
        self.periods += 1
        return abs(self._way) > BLIND and self.periods > LATE  # what was sent last may not have acted yet


def last_change(count: NDArray[np.int64], open_wire: bool) -> int:
    """Return the row of the last change of a count [K].

    An encoder with an `open_wire` counts to and fro by one while it turns: that is no change.
    """
    steps = np.diff(count, prepend=count[0])
    changes = np.flatnonzero(steps)
    last = 0
    for row in changes:
        if abs(count[row] - count[last]) > 1:
            last = int(row)
    to_and_fro = {-1, 1} <= {*steps[last + 1 :].tolist()}
    return last if open_wire and to_and_fro else int(changes.max(initial=0))


def cart_froze(motor: NDArray[np.int64], gaps: Array, last: int, hard_push: int) -> bool:
    """Return whether pushes in both directions left the count as it is since row `last`.

    `motor` [T]; `gaps` [T] s. The period in which a push begins does not count.
    """
    push = np.where(np.abs(motor) < hard_push, 0, np.sign(motor))
    lasted = np.diff(push, prepend=0)[last:] == 0
    return all((gaps[last : len(push)] * (lasted & (push[last:] == side))).sum() > PUSHED for side in (1, -1))


def stopped_dead(count: NDArray[np.int64], gaps: Array, last: int, sudden: float) -> bool:
    """Return whether a count [K] faster than `sudden`, counts/s, did not change any more after row `last`."""
    rest = gaps[last : len(count) - 1].sum()
    return bool(last and rest > STILL and abs(count[last] - count[last - 1]) > sudden * gaps[last - 1])


def balanced(theta: Array, gaps: Array) -> bool:
    """Return whether the pole leant, but did not fall, at the angles `theta` [K], rad, on a standing cart.

    On a standing cart its angle a from the true upright obeys a_ddot = w^2 a, so a(t - h) + a(t + h) =
    2 cosh(w h) a(t) > 5 a(t): less than a third of the second difference is a(t). The angle was in error, or
    the cart moved, if no error of the zero below `LEANING` explains the three measured angles.
    """
    half = round(HALF / float(np.median(gaps))) if len(gaps) else 0
    if half == 0 or len(theta) <= 2 * half:
        return False
    angle = wrap(theta)
    before, now, after = angle[: -2 * half], angle[half:-half], angle[2 * half :]
    near = np.maximum(np.abs(before), np.abs(after)) < FALLEN
    nearest = now - (before + after - 2 * now) / 3  # to upright: the zero lies between this and `now`
    leans = (now * nearest > 0) & (np.minimum(np.abs(now), np.abs(nearest)) > LEANING)
    return bool((near & leans).any())


def pole_froze(speed: Array) -> bool:
    """Return whether the cart's speed, m/s, has risen and fallen by `SPEED_CHANGE` since the last change."""
    if not len(speed):
        return False
    rise = (speed - np.minimum.accumulate(speed)).max()
    fall = (np.maximum.accumulate(speed) - speed).max()
    return bool(min(rise, fall) >= SPEED_CHANGE)


def shortened(episode: Episode, steps: int, why: str) -> Episode:
    """Return the first `steps` of an episode, which then ends by a fault; log `why`."""
    left_out = f"{why}: the last {episode.steps - steps} of {episode.steps} control periods do not count"
    LOGGER.warning("%s", left_out)
    return replace(episode.part(0, steps), ended_by=str(Ending.FAULT), left_out=left_out)
