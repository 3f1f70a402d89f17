"""Schedules: pure functions of progress, so that a resumed run needs to remember nothing."""

import math


def linear(start: float, end: float, progress: float) -> float:
    """From `start` at progress 0 to `end` at 1, and `end` from there on."""
    return start + (end - start) * min(max(progress, 0.0), 1.0)


def half_cosine(start: float, end: float, progress: float) -> float:
    """From `start` at progress 0 to `end` at 1 along half a cosine."""
    return linear(end, start, 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))
