"""Moves of a cart, of which experiments consist, and the guard that brakes it before it gets to an end.

A move is a generator: it yields the motor value of the next period and is sent the observation at its end.

The guard brakes a cart that is not known yet, at any control period T. It has the form of the track guard
(`envs/guard.py`). If it lets a cart run, the next command in force comes T + RESPONSE later. Until then the
cart may gain speed at the rate ACCELERATION, and it already has gained some: the measured speed is half a
period old. A cart of measured speed v that is braked just as hard, a = ACCELERATION, therefore runs on by

    (v + a T / 2) t + a t^2 / 2 + (v + a g)^2 / (2 a),    t = T + RESPONSE,    g = t + T / 2,

which is the guard's margin + delay v + v^2 / (2 a) with

    margin = a (T t + t^2 + g^2) / 2,    delay = t + g.

ACCELERATION is that of ip02; a is scaled to the cart by the rough numbers of its file. If its brake b is
weaker than a, v^2 is over 2 b, and g^2 a / b and g a / b stand for g^2 and g.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np

from cartpole_rl.envs.guard import guard_side
from cartpole_rl.envs.settings import LARGEST_MARGIN, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware, nominal_hardware

CLEARANCE = 0.0926  # m to the soft limit: what carts overrun that are harder to brake than assumed, and more
LARGEST_CLEARANCE = 0.25  # of the way from the middle to the soft limit, on a short track
BREAKAWAY = 1.2  # times the motor value that just moves the cart by its file; moves most carts
RESPONSE = 0.035  # s, latency and lag of the motor
ACCELERATION = 1 / 0.24  # m/s^2, of ip02
SHORTEST = 0.02  # s: shorter periods have its numbers, since carts have longer latencies than assumed, too
BRAKE = 220  # motor value of the guard

LEAST_REACH = 0.05  # m from the middle: less shows no friction
SIDE = 20 / 27  # share of the guard's reach where a run to the other side starts: 0.2 m at 20 ms
CLOSE, SLOW = 0.02, 0.05  # m, m/s: at the target, and at rest
LONGEST_MOVE = 4.0  # s
STANDING, LONGEST_STOP = 0.005, 3.0  # m/s, s: at the end of an experiment


class Observed(NamedTuple):
    """The observation at the end of a period."""

    x: float  # m
    x_dot: float  # m/s, a difference
    theta: float  # rad, 0 upright
    theta_dot: float  # rad/s, a difference


Moves = Generator[int, Observed, int | None]


class Task(NamedTuple):
    """The conditions of an experiment."""

    period: float  # s, of control
    random: np.random.Generator
    breakaway: int  # motor value that moves the cart from rest
    hardware: Hardware

    @classmethod
    def of(cls, period: float, random: np.random.Generator, hardware: Hardware) -> "Task":
        """Return the conditions before the cart is known."""
        return cls(period, random, min(LARGEST_MOTOR, round(BREAKAWAY * hardware.breakaway_motor)), hardware)

    @property
    def track_end(self) -> float:
        """How far from the middle an experiment may get, m."""
        return track_end(self.hardware)

    @property
    def side(self) -> float:
        """The distance from the middle where a run to the other side starts, m."""
        return SIDE * reach(self.period, self.hardware)

    def periods(self, seconds: float) -> int:
        """Return the number of control periods in a time."""
        return round(seconds / self.period)

    def more(self, of_ip02: float) -> float:
        """Return the motor value that accelerates this cart as `of_ip02` does ip02, beyond friction."""
        return of_ip02 * strength(nominal_hardware()) / strength(self.hardware)

    def least(self, of_ip02: int) -> int:
        """Return a motor value about the one that just moves the cart, as `of_ip02` is for ip02."""
        return max(1, round(of_ip02 * self.hardware.breakaway_motor / nominal_hardware().breakaway_motor))

    def moving(self, more: int) -> int:
        """Return a motor value that moves the cart, by `more` than needed; `more` is that of ip02."""
        return min(LARGEST_MOTOR, self.breakaway + round(self.more(more)))


def hold(motor: int, seconds: float, task: Task) -> Moves:
    """Hold one motor value for `seconds` s."""
    for _ in range(task.periods(seconds)):
        yield motor
    return None


def push(motor: int, speed: float, task: Task) -> Moves:
    """Hold one motor value until the cart reaches a speed, m/s, or has moved 0.1 m, at most half a second."""
    start = now = yield motor
    for _ in range(task.periods(0.5)):
        if abs(now.x - start.x) > 0.1 or abs(now.x_dot) > speed:
            break
        now = yield motor
    return None


def until_stopped(motor: int, side: int, task: Task) -> Moves:
    """Hold one motor value until the cart stops or gets near the end at `side`, then rest briefly."""
    far = task.side + 0.03  # m
    now = yield motor
    for _ in range(task.periods(LONGEST_MOVE)):
        if abs(now.x_dot) < SLOW / 5 or side * now.x > far:
            break
        now = yield motor
    yield from hold(0, 0.2, task)
    return None


def go_to(target: float, task: Task) -> Moves:
    """Bring the cart near `target` m."""
    now = yield 0
    for _ in range(task.periods(LONGEST_MOVE)):
        away = target - now.x
        if abs(away) < CLOSE and abs(now.x_dot) < SLOW:
            break
        wish = np.clip(6 * away, -0.5, 0.5) - now.x_dot  # m/s
        now = yield round(np.sign(wish) * 0.8 * task.breakaway + task.more(250) * wish)
    yield 0
    return None


def and_stop(moves: Moves, task: Task) -> Moves:
    """Make the moves, then hold motor 0 until the cart stands; return the result of the moves."""
    breakaway = yield from moves
    for _ in range(task.periods(LONGEST_STOP)):
        now = yield 0
        if abs(now.x_dot) < STANDING:
            break
    return breakaway


def strength(hardware: Hardware) -> float:
    """Return the acceleration of a cart by a motor value of 1 beyond the one that just moves it, m/s^2."""
    return 1 / (hardware.motor_per_newton * hardware.moving_mass)


def track_end(hardware: Hardware) -> float:
    """Return how far from the middle an experiment may get, m."""
    soft = hardware.half_span - hardware.soft_limit
    return soft - min(CLEARANCE, LARGEST_CLEARANCE * soft)


def experiment_guard(period: float, hardware: Hardware) -> TrackGuard:
    """Return the numbers of the guard at a control period, s.

    Raises ConfigError for a cart that cannot be braked, or has no room for it on its track.
    """
    given, end = period, track_end(hardware)
    period = max(period, SHORTEST)
    runs_on = period + RESPONSE
    gains = runs_on + period / 2
    full, of_ip02 = (
        strength(each) * (LARGEST_MOTOR - each.breakaway_motor) for each in (hardware, nominal_hardware())
    )
    gain = ACCELERATION * full / of_ip02
    brake = strength(hardware) * (BRAKE - 2 * hardware.motor_offset + hardware.breakaway_motor)
    if brake <= 0:
        raise ConfigError(
            f"cart.motor_offset={hardware.motor_offset:g}: experiments brake with a motor value of {BRAKE}, "
            "which brakes no such cart; give less"
        )
    deceleration = min(gain, brake)
    margin = gain / 2 * (period * runs_on + runs_on**2 + gain / deceleration * gains**2)
    delay = runs_on + gain / deceleration * gains
    if margin > min(LARGEST_MARGIN, end - LEAST_REACH):
        raise ConfigError(
            f"control_period={given:g}: full motor accelerates the cart of cart= by {gain:.1f} m/s^2; to "
            f"brake it takes {margin:.2f} m of the {end:.2f} m to each side; give a shorter period, or "
            "correct motor_per_newton, moving_mass or track_span"
        )
    return TrackGuard(margin=round(margin, 4), delay=delay, deceleration=deceleration)


def reach(period: float, hardware: Hardware) -> float:
    """Return how far from the middle the guard lets a cart at rest be, m."""
    return track_end(hardware) - experiment_guard(period, hardware).margin


def guarded(motor: float, x: float, x_dot: float, guard: TrackGuard, track_end: float) -> int:
    """Return the motor value, or one that brakes if the cart would get beyond `track_end`, m."""
    side = guard_side(x, x_dot, track_end, guard)
    if side and motor * side < BRAKE:
        return int(side) * BRAKE
    return int(np.clip(motor, -LARGEST_MOTOR, LARGEST_MOTOR))
