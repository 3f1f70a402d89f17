"""The emulated cart's encoders and track. The host has its own numbers: `rig/hardware.py`."""

import math

CART_METRES = 22749e-9  # a count; INFO reports whole nanometres
CART_NANOMETRES = round(CART_METRES * 1e9)  # the same in whole nanometres, for whole-number arithmetic
POLE_COUNTS = 4096  # a turn
POLE_RADIANS = 2 * math.pi / POLE_COUNTS  # a count
SPAN = 0.814  # m, nominal distance between the stops
