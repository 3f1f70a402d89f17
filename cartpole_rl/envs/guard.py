"""The track guard: full motor inward where the cart could otherwise not be stopped before the track's end.

It is part of the hardware transform, so that simulation and cart have it alike and an agent learns with it.
It lies above the limits of the cart (soft and hard limit, docs/protocol.md) and below the agent.

A cart at position x with speed v, both positive to the right, is predicted to come to rest, under full motor
to the left, at

    x + margin + delay v + v |v| / (2 deceleration)

Beyond the track's end, the guard replaces the agent's motor value by full motor to the left; likewise on the
left. The three numbers are fitted to the carts in question: see `envs/guard_fitting.py`.
"""

from typing import TypeVar

from torch import Tensor

from cartpole_rl.envs.settings import TrackGuard

Number = TypeVar("Number", float, Tensor)


def stopping_distance(x_dot: Number, guard: TrackGuard) -> Number:
    """Return the way to the right, m, that a cart of speed `x_dot` m/s makes under full motor to the left."""
    return guard.margin + guard.delay * x_dot + x_dot * abs(x_dot) / (2 * guard.deceleration)


def guard_side(x: Number, x_dot: Number, track_end: Number | float, guard: TrackGuard) -> Number:
    """Return the direction of the guard's full motor: 1 to the right, -1 to the left, 0 if it is not needed.

    `x` m from the middle of the track, `x_dot` m/s, `track_end` m, all floats or [N].
    """
    too_far_right = x + stopping_distance(x_dot, guard) > track_end
    too_far_left = -x + stopping_distance(-x_dot, guard) > track_end
    return 1 * too_far_left - 1 * too_far_right
