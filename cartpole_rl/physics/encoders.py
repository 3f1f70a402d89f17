"""The encoders of the cart: the size of one count. Source: Quanser IP02 user manual."""

import math

CART_METRES_PER_COUNT = 2.2749e-5  # encoder pinion of 14.83 mm radius, 4096 counts a turn
POLE_COUNTS_PER_TURN = 4096
POLE_RADIANS_PER_COUNT = 2 * math.pi / POLE_COUNTS_PER_TURN
