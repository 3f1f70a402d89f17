"""Each guard alone, fed with counts: where it is silent, and the first period in which it is not."""

import math

import pytest

from cartpole_rl.emulator.guards import (
    PUSH_US,
    SPEED_CHANGE,
    FrozenCartWatch,
    FrozenPoleWatch,
)
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
    [
        ([0, FAST, FAST], [5, 5, 5]),
        ([0, 0.8 * SPEED_CHANGE, 0], [5, 5, 5]),
        ([0, FAST, 0], [5, 7, 7]),
    ],
    ids=["only faster", "too little", "two counts"],
)
def test_no_frozen_pole_count(speeds: list[float], poles: list[int]) -> None:
    assert not pole_encoder_frozen(speeds, poles)
