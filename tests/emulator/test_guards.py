"""Each guard alone, fed with counts: where it is silent, and the first period in which it is not.

Those of homing, too: a window covers its whole time, even if a period was late or early; a held cart is seen.
"""

import math
from itertools import pairwise

import pytest

from cartpole_rl.emulator.guards import PUSH_US, SPEED_CHANGE, FrozenCartWatch, FrozenPoleWatch
from cartpole_rl.emulator.homing import HeldWatch, Reading, Window
from cartpole_rl.rig.hardware import hardware_of, nominal_hardware

PERIOD = 62_500  # us
RIG = nominal_hardware()


def cart_encoder_frozen(counts: list[int], motors: list[int]) -> list[bool]:
    watch = FrozenCartWatch(RIG)
    return [watch.frozen(count, motor, PERIOD) for count, motor in zip(counts, motors, strict=True)]


@pytest.mark.parametrize("lasts", [3, 4, 5])
def test_short_pushes_each_way_add_up(lasts: int) -> None:
    """The first period of a push does not count."""
    watch, motors = FrozenCartWatch(RIG), ([255] * lasts + [-255] * lasts) * 5
    answers = [watch.frozen(7, motor, 20_000) for motor in motors]
    whole, rest = divmod(PUSH_US // 20_000, lasts - 1)
    needed = 2 * lasts * whole + lasts + 1 + rest if rest else 2 * lasts * whole
    assert answers.index(True) + 1 == needed


@pytest.mark.parametrize(
    ("counts", "motors"),
    [
        ([7] * 40, [255] * 40),
        ([7] * 40, [255, -255] * 20),
        ([7] * 20 + [9] * 20, [255] * 20 + [-255] * 20),
        ([7] * 40, [199] * 20 + [-199] * 20),
    ],
    ids=["one way", "short pushes", "two counts", "weak pushes"],
)
def test_no_frozen_cart_count(counts: list[int], motors: list[int]) -> None:
    assert not any(cart_encoder_frozen(counts, motors))


def test_the_coarsest_rig_is_watched_too() -> None:
    watch = FrozenCartWatch(hardware_of({"cart_nanometres_per_count": 1_000_000}))
    assert any(watch.frozen(7, motor, 20_000) for motor in ([255] * 25 + [-255] * 25) * 2)


def pole_encoder_frozen(speeds: list[float], poles: list[int]) -> bool:
    watch, cart, answers = FrozenPoleWatch(RIG), 0, [False]
    watch.frozen(poles[0], cart, PERIOD)
    for speed, pole in zip(speeds, poles, strict=True):
        cart += math.ceil(speed * PERIOD / RIG.cart_nanometres_per_count / 1000)
        answers.append(watch.frozen(pole, cart, PERIOD))
    return answers[-1]


FAST = round(1.1 * SPEED_CHANGE)  # um/s


def test_a_pole_count_is_frozen_when_the_cart_speeds_up_and_slows_down() -> None:
    assert pole_encoder_frozen([0, FAST, 0], [5, 5, 5])
    assert pole_encoder_frozen([0, -FAST, 0], [5, 5, 5])
    assert pole_encoder_frozen([0, FAST, 0], [5, 6, 5])  # an open wire


@pytest.mark.parametrize(
    ("speeds", "poles"),
    [([0, FAST, FAST], [5, 5, 5]), ([0, 0.8 * SPEED_CHANGE, 0], [5, 5, 5]), ([0, FAST, 0], [5, 7, 7])],
    ids=["only faster", "too little", "two counts"],
)
def test_no_frozen_pole_count(speeds: list[float], poles: list[int]) -> None:
    assert not pole_encoder_frozen(speeds, poles)


LENGTH = 400_000  # us
TICK = 20_000


def filled(periods: list[int]) -> list[bool]:
    """Return after each period whether the window is full."""
    window, full = Window(LENGTH), []
    for number, us in enumerate(periods):
        window.add(number % 2, us)
        full.append(window.spread < math.inf)
    return full


@pytest.mark.parametrize("late", [TICK, 40_000, 200_000, 10_000_000])
def test_a_late_period_does_not_fill_a_window_early(late: int) -> None:
    periods = [TICK] * 5 + [late] + [TICK] * 20
    assert filled(periods).index(True) * TICK == LENGTH


def test_a_short_period_does_not_fill_a_window_early() -> None:
    periods = [TICK] * 5 + [TICK // 2] + [TICK] * 40
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
    watch = HeldWatch(RIG.model_copy(update={"cart_nanometres_per_count": nanometres}))
    readings = [Reading(count, 0, 15_000) for count in counts]
    found = [watch.is_held(*pair, direction=1, motor=0, travels=True) for pair in pairwise(readings)]
    assert found == [False] * (len(counts) - 2) + [held]
