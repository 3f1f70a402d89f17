"""The guard of the experiments: it brakes a cart that is not known yet, at any control period.

It has the form of the track guard (`envs/guard.py`), but its numbers follow from the control period T. If it
lets a cart run, the next command in force comes T + RESPONSE later. Until then the cart may gain speed at the
rate ACCELERATION, and it already has gained some: the measured speed is half a period old. A cart of
measured speed v that is braked just as hard, a = ACCELERATION, therefore runs on by

    (v + a T / 2) t + a t^2 / 2 + (v + a g)^2 / (2 a),    t = T + RESPONSE,    g = t + T / 2,

which is the guard's margin + delay v + v^2 / (2 a) with

    margin = a (T t + t^2 + g^2) / 2,    delay = t + g.
"""

import numpy as np

from cartpole_rl.envs.guard import guard_side
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.rig.hardware import LARGEST_MOTOR

TRACK_END = 0.2874  # m from the middle: 0.3, less what carts overrun that are harder to brake than assumed
RESPONSE = 0.035  # s, latency and lag of the motor
ACCELERATION = 1 / 0.24  # m/s^2
SHORTEST = 0.02  # s: shorter periods have its numbers, since carts have longer latencies than assumed, too
BRAKE = 220  # motor value of the guard


def experiment_guard(period: float) -> TrackGuard:
    """Return the numbers of the guard at a control period, s."""
    period = max(period, SHORTEST)
    runs_on = period + RESPONSE
    gains = runs_on + period / 2
    margin = ACCELERATION / 2 * (period * runs_on + runs_on**2 + gains**2)
    return TrackGuard(margin=round(margin, 4), delay=runs_on + gains, deceleration=ACCELERATION)


def reach(period: float) -> float:
    """Return how far from the middle the guard lets a cart at rest be, m."""
    return TRACK_END - experiment_guard(period).margin


def guarded(motor: float, x: float, x_dot: float, guard: TrackGuard) -> int:
    """Return the motor value, or one that brakes if the cart would get beyond TRACK_END."""
    side = guard_side(x, x_dot, TRACK_END, guard)
    if side and motor * side < BRAKE:
        return int(side) * BRAKE
    return int(np.clip(motor, -LARGEST_MOTOR, LARGEST_MOTOR))
