"""Encoders, track and motor range of the cart that the host drives. Source: Quanser IP02 user manual.

The cart reports the same numbers in INFO; a cart that reports others is refused.
"""

import math

CART_METRES_PER_COUNT = 2.2749e-5  # encoder pinion of 14.83 mm radius, 4096 counts a turn
CART_NANOMETRES_PER_COUNT = round(CART_METRES_PER_COUNT * 1e9)
POLE_COUNTS_PER_TURN = 4096
POLE_RADIANS_PER_COUNT = 2 * math.pi / POLE_COUNTS_PER_TURN
HALF_SPAN = 0.407  # m, middle of the track to a stop
SPAN = 2 * HALF_SPAN  # m, from stop to stop
LARGEST_MOTOR = 255  # motor value in size, to the left (negative) and to the right


def cart_counts(metres: float) -> int:
    """Return a distance of the cart in counts."""
    return round(metres / CART_METRES_PER_COUNT)


def pole_counts(degrees: float) -> int:
    """Return an angle of the pole in counts."""
    return round(degrees / 360 * POLE_COUNTS_PER_TURN)
