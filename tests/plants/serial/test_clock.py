"""The host's clock goes on while the computer sleeps, and a cart's clock is compared with it."""

import random
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from serial_peer import INFO, HomingForever, quick_settings, wait_for

from cartpole_rl.errors import LinkError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.link import now
from cartpole_rl.plants.serial.tracking import LARGEST_RATE_ERROR, ClockComparison
from cartpole_rl.wire.messages import Flags

PERIOD = 0.02  # s by the cart's clock
WRONG, RIGHT = (1.3, 0.6, 1.02, 0.985), (1.0, 1.005, 0.995)


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="Linux's clock")
def test_the_clock_counts_the_time_asleep() -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    assert before <= now() <= time.clock_gettime(time.CLOCK_BOOTTIME)


class Arrivals:
    """States of a cart whose clock has a rate, compared with the host's clock; all times are made up."""

    def __init__(self, rate: float) -> None:
        self.rate, self.now, self.arrived = rate, 1000.0, 0.0
        self.comparison = ClockComparison()
        self.rates: list[float] = []  # that the comparison found

    def pass_period(self, until: float = 0.0) -> None:
        """A state is sent a period after the last one, and read at once, or `until` then if that is later."""
        self.now += PERIOD / self.rate
        self.arrived = max(self.arrived, self.now, until)
        rate = self.comparison.add(PERIOD, self.arrived)
        self.rates += [] if rate is None else [rate]

    def pass_seconds(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.pass_period()

    def pause(self, seconds: float) -> None:
        """The host reads nothing for so long, and then all that waits."""
        until = self.now + seconds
        while self.now < until:
            self.pass_period(until)

    @property
    def largest_error(self) -> float:
        return max(abs(rate - 1) for rate in self.rates)


@pytest.mark.parametrize("rate", [*WRONG, *RIGHT])
def test_a_rate_is_measured_over_8_seconds(rate: float) -> None:
    arrivals = Arrivals(rate)
    arrivals.pass_seconds(9 + min(1, rate))
    assert not arrivals.rates
    arrivals.pass_seconds(2)
    assert arrivals.rates[0] == pytest.approx(rate, rel=3e-3)
    assert (arrivals.largest_error > LARGEST_RATE_ERROR) == (rate in WRONG)


@pytest.mark.parametrize("rate", [*WRONG, *RIGHT])
@pytest.mark.parametrize("seed", range(5))
def test_so_it_is_on_a_host_that_pauses_again_and_again(rate: float, seed: int) -> None:
    arrivals, dice = Arrivals(rate), random.Random(seed)
    for _ in range(200):
        arrivals.pause(dice.uniform(0, 0.3))
    assert (arrivals.largest_error > LARGEST_RATE_ERROR) == (rate in WRONG)
    assert arrivals.rates[-1] == pytest.approx(rate, rel=LARGEST_RATE_ERROR)


@pytest.mark.parametrize("pause", [0.4, 0.6, 2.2, 5.0, 60.0])
def test_states_that_waited_for_a_host_are_not_compared(pause: float) -> None:
    """As while a person reads a question: a buffer may deliver all of them at once."""
    arrivals = Arrivals(1.0)
    for _ in range(6):
        arrivals.pass_seconds(12)
        arrivals.pause(pause)
    assert arrivals.rates
    assert arrivals.largest_error < LARGEST_RATE_ERROR


def test_a_wrong_rate_is_found_after_a_pause() -> None:
    arrivals = Arrivals(1.3)
    arrivals.pause(30)
    assert not arrivals.rates
    arrivals.pass_seconds(14)
    assert arrivals.rates[0] == pytest.approx(1.3, rel=3e-3)


def test_a_single_busy_second_is_not_taken_for_the_cart() -> None:
    arrivals = Arrivals(1.0)
    for _ in range(4):
        arrivals.pass_seconds(3.5)
        for _ in range(5):
            arrivals.pause(0.45)
    assert arrivals.largest_error < LARGEST_RATE_ERROR


class Ticking(HomingForever):
    """A cart whose clock passes `rate` s in a second."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.paced, self.rate = True, rate
        self.info = replace(INFO, period_us=100_000)  # no busy computer takes so long to answer

    @contextmanager
    def ticking(self) -> Iterator[None]:
        stopped, began = threading.Event(), time.monotonic()

        def tick() -> None:
            while not stopped.wait(0.02):
                self.tick(time_us=round((time.monotonic() - began) * self.rate * 1e6) + 1)

        ticking = threading.Thread(target=tick)
        ticking.start()
        try:
            yield
        finally:
            stopped.set()
            ticking.join()


@pytest.mark.parametrize("homes", [True, False])
def test_a_cart_with_a_wrong_clock_is_not_driven(homes: bool) -> None:
    with Ticking(1.3) as peer, peer.ticking(), SerialCart(quick_settings(peer.port, timeout=10.0)) as cart:
        with pytest.raises(LinkError, match=r"passes 1\.[23]\d\d s in a second of this computer") as told:
            cart.home() if homes else read(cart)
        assert str(told.value).endswith("so all speeds would be wrong: correct the timer in its firmware")
    wait_for(lambda: not peer.flags & Flags.ARMED)


def read(cart: SerialCart) -> None:
    while True:
        cart.get_state()
