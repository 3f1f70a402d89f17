"""The encoders of the emulated cart: the size of one count."""

import math

CART_METRES = 22749e-9  # a count
POLE_COUNTS = 4096  # a turn
POLE_RADIANS = 2 * math.pi / POLE_COUNTS  # a count
