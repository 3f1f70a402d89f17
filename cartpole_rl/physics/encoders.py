"""The encoders of the cart: what one count is. Source: Quanser IP02 user manual; computed from its gears."""

import math

CART_METRES_PER_COUNT = 2.2749e-5  # pinion of 6.35e-3 m, gear, 4096 counts a turn
POLE_COUNTS_PER_TURN = 4096
POLE_RADIANS_PER_COUNT = 2 * math.pi / POLE_COUNTS_PER_TURN
