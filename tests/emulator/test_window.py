"""The window of homing covers its whole time, even if a period was late or early."""

import math

import pytest

from cartpole_rl.emulator.homing import Window

LENGTH = 400_000  # us
PERIOD = 20_000


def filled(periods: list[int]) -> list[bool]:
    """Return after each period whether the window is full."""
    window, full = Window(LENGTH), []
    for number, us in enumerate(periods):
        window.add(number % 2, us)
        full.append(window.spread < math.inf)
    return full


def test_a_window_is_full_after_its_time() -> None:
    assert filled([PERIOD] * 22).index(True) * PERIOD == LENGTH


@pytest.mark.parametrize("late", [40_000, 200_000, 10_000_000])
def test_a_late_period_does_not_fill_it_early(late: int) -> None:
    periods = [PERIOD] * 5 + [late] + [PERIOD] * 20
    assert filled(periods).index(True) * PERIOD == LENGTH


def test_a_short_period_does_not_fill_it_early() -> None:
    periods = [PERIOD] * 5 + [PERIOD // 2] + [PERIOD] * 40
    assert sum(periods[1 : filled(periods).index(True) + 1]) >= LENGTH
