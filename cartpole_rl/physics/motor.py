"""The range of motor values."""

LARGEST_MOTOR = 255  # in size, to the left (negative) and to the right
