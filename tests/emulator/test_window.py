"""The window of homing covers its whole time, even if a period was late or early; a held cart is seen."""

import math
from itertools import pairwise

import pytest

from cartpole_rl.emulator.homing import HeldWatch, Reading, Window
from cartpole_rl.rig.hardware import nominal_hardware

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


@pytest.mark.parametrize(
    ("nanometres", "counts", "held"),  # 15 ms apart
    [
        (1_000_000, (0, 3, 6, 7), False),  # 0.12 m/s may look so
        (22_750, (0, 132, 264, 300), False),
        (22_750, (0, 132, 264, 264, 264), True),
        (22_750, (0, 132, 132, 396, 396), False),  # of a board that sends each count twice
        (22_750, (0, -132, -264, -264, -264), False),  # it ran the other way
    ],
)
def test_a_travelling_cart_that_stops_at_once_is_held(
    nanometres: int, counts: tuple[int, ...], held: bool
) -> None:
    watch = HeldWatch(nominal_hardware().model_copy(update={"cart_nanometres_per_count": nanometres}))
    readings = [Reading(count, 0, 15_000) for count in counts]
    found = [watch.is_held(*pair, direction=1, motor=0, travels=True) for pair in pairwise(readings)]
    assert found == [False] * (len(counts) - 2) + [held]
