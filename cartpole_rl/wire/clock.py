"""Differences of the cart's tick counter and clock, which are unsigned 32-bit numbers and wrap.

At 50 Hz the ticks wrap after 2.7 years, the microseconds after 71.6 minutes.
"""

WRAP = 2**32


def ticks_between(before: int, after: int) -> int:
    """Return the periods from tick `before` to tick `after`, 0 to 2^32 - 1."""
    return (after - before) % WRAP


def microseconds_between(before_us: int, after_us: int) -> int:
    """Return the microseconds from `before_us` to `after_us` by the cart's clock, 0 to 2^32 - 1."""
    return (after_us - before_us) % WRAP


def seconds_between(before_us: int, after_us: int) -> float:
    """Return the seconds from `before_us` to `after_us` by the cart's clock."""
    return microseconds_between(before_us, after_us) * 1e-6


def went_back(difference: int) -> bool:
    """Return whether a difference of ticks or microseconds is over half a wrap, so the later one is older."""
    return difference > WRAP // 2
