"""The controller that centres a cart, on made-up states. On emulated carts: test_recentring.py."""

from itertools import cycle, pairwise

import pytest

from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import GENTLE, ArmedCart, Centring, nominal_deadband
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.wire.messages import State

IP02 = nominal_hardware()
PERIOD_US = 20_000
FAR = 4000  # counts, 91 mm


def at(counts: int, period: int = 0) -> State:
    return State(period, period * PERIOD_US, counts, 2048, 0, 0, 0, 0)


def motors(controller: Centring, counts: int, periods: int) -> list[int]:
    """Motor values while the cart stands still at `counts`."""
    states = [at(counts, period) for period in range(periods + 1)]
    return [controller.motor(*pair) for pair in pairwise(states)]


@pytest.mark.parametrize("counts", [-FAR, FAR])
def test_a_cart_that_does_not_move_is_pushed_towards_the_middle_harder_and_harder_up_to_what_is_gentle(
    counts: int,
) -> None:
    values = motors(Centring(IP02, 0.02, nominal_deadband(IP02)), counts, 200)
    sizes = [-value if counts > 0 else value for value in values]
    assert sizes == sorted(sizes)
    assert 50 < sizes[0] < 90
    assert sizes[-1] == 199  # below hard_push


def test_the_measured_dead_band_of_a_side_is_where_the_push_begins() -> None:
    deadband = {1: 110, -1: 70}
    assert motors(Centring(IP02, 0.02, deadband), -FAR, 1)[0] - 110 == pytest.approx(2.5, abs=1.5)
    assert motors(Centring(IP02, 0.02, deadband), FAR, 1)[0] + 70 == pytest.approx(-2.5, abs=1.5)


def test_the_planned_speed_changes_gently_and_slows_down_near_the_middle() -> None:
    controller = Centring(IP02, 0.02, nominal_deadband(IP02))
    controller.motor(at(-FAR, 0), at(-FAR, 1))
    assert controller.planned == pytest.approx(GENTLE * 0.02)
    for period in range(1, 100):
        controller.motor(at(-440, period), at(-440, period + 1))
    assert controller.planned == pytest.approx(0.01, rel=0.01)  # 10 mm in a second


def test_a_cart_that_is_too_fast_is_braked() -> None:
    before, state = at(-FAR, 0), at(-FAR + 400, 1)
    assert Centring(IP02, 0.02, nominal_deadband(IP02)).motor(before, state) < 0


class Flickering(ArmedCart):
    """A cart whose count goes to and fro between 0 and `counts`, of 1 um each."""

    period = 0.02

    def __init__(self, counts: int) -> None:
        self.hardware = IP02.model_copy(update={"cart_nanometres_per_count": 1000})
        self.counts = cycle((0, counts))

    def drive(self, motor: int) -> State:
        return at(next(self.counts))


def test_a_cart_rests_by_its_motion_however_fine_its_encoder_is() -> None:
    Flickering(45).rest()
    with pytest.raises(NotReadyError, match="does not come to rest"):
        Flickering(46).rest()
