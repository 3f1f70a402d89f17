"""Schedules as pure functions of progress: a resumed run has no schedule to restore."""

import math


def linear(start: float, end: float, progress: float) -> float:
    """Return a value that goes from `start` at progress 0 to `end` at 1, and stays there."""
    return start + (end - start) * min(max(progress, 0.0), 1.0)


def half_cosine(start: float, end: float, progress: float) -> float:
    """Return a value that goes from `start` at progress 0 to `end` at 1 along half a cosine."""
    return linear(end, start, 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))
