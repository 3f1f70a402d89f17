"""The rules that a bridge keeps, with a driver that is played by the test, in its own time."""

import math
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from threading import Event
from typing import Any

import pytest

from cartpole_rl.choices import choice
from cartpole_rl.emulator.guards import LEVER, TrackLimits, lever_um
from cartpole_rl.emulator.homing import HomingError, Reading
from cartpole_rl.errors import ConfigError, LinkError
from cartpole_rl.plants.drivers.bridge import CONFIRMED, STOPS, Bridge, MotorCommands, StandIn
from cartpole_rl.plants.drivers.driver import Driver, Measurement
from cartpole_rl.plants.settings import DriverSettings
from cartpole_rl.rig.hardware import Encoders, hardware_of
from cartpole_rl.rig.parameters import completed
from cartpole_rl.signals import until_stopped
from cartpole_rl.wire.frames import encode_frame
from cartpole_rl.wire.messages import Fault, Flags, Home, Message, SetMotor, Start, Stop

pytestmark = pytest.mark.usefixtures("same_signals")  # the end of a bridge replaces handlers
RIG = hardware_of(choice("cart/stepper"))  # 25 um, 4096 counts a turn
PERIOD_US = 10_000


class Played(Driver):
    """A board that measures what the test says."""

    def __init__(self, settings: DriverSettings, encoders: Encoders) -> None:
        super().__init__(settings, encoders)
        self.sent: list[float] = []
        self.stops = 0
        self.script: list[Any] = []

    def open(self) -> None:
        pass

    def read(self, timeout: float) -> Measurement | None:
        following = self.script.pop(0) if self.script else None
        if isinstance(following, BaseException):
            raise following
        return following

    def send(self, value: float) -> None:
        self.sent.append(value)

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass


class Frames:
    """The port of a host that says nothing."""

    def send(self, frame: bytes) -> None:
        pass

    def receive(self, timeout: float) -> list[bytes]:
        time.sleep(timeout)
        return []


def settings(**given: Any) -> DriverSettings:
    place = "cartpole_rl.plants.drivers.text:TextDriver"  # which Playing replaces
    return DriverSettings(**{"kind": "driver", "driver": place, "port": "x", "full": 255} | given)


class Playing(Bridge):
    """A bridge whose clock the test sets."""

    def __init__(self, **given: Any) -> None:
        chosen = settings(**given)
        self.played, self.now = Played(chosen, RIG.encoders), 0
        super().__init__(chosen, RIG, self.played, None, LEVER)
        self._channel = Frames()  # type: ignore[assignment]
        self._begin(PERIOD_US)

    def _now_us(self) -> int:
        return self.now

    def wait(self, periods: int = 1) -> None:
        for _ in range(periods):
            self.now += PERIOD_US
            self._pass(None)

    def measure(self, *carts: Any) -> list[bool]:
        """Measure cart counts a period apart; return which were taken."""
        taken = []
        for cart in carts:
            self.now += PERIOD_US
            before = self.played.bad
            self._pass(Measurement(cart, 0, self.now))
            taken.append(self.played.bad == before)
        return taken

    def run_and_end(self) -> None:
        """Run until something is raised, and end."""
        with self:
            self.run(Frames())  # type: ignore[arg-type]

    def drive(self, motor: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let the rules ask for a motor value, whatever is measured; 0 for a late host."""
        self._stand_in.armed = self._stand_in.homed = True
        monkeypatch.setattr(StandIn, "motor", motor)
        monkeypatch.setattr(StandIn, "is_idle", lambda stand_in, now_us: motor == 0)

    def home(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let the rules home the cart, which is not armed any more, with the motor value 0."""
        self._stand_in.armed = False
        monkeypatch.setattr(StandIn, "motor", 0)
        monkeypatch.setattr(StandIn, "homing", True)
        monkeypatch.setattr(StandIn, "is_idle", lambda stand_in, now_us: False)
        monkeypatch.setattr(StandIn, "tick", lambda *arguments: [])


def test_a_brake_ends_when_the_board_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Playing(sends="value")
    bridge.measure(0, 0)
    bridge.drive(-255, monkeypatch)
    bridge.wait(2)
    assert bridge.played.sent[-1] == -255
    bridge.wait(4)
    sent, stops = len(bridge.played.sent), bridge.played.stops
    bridge.wait(5)
    assert len(bridge.played.sent) == sent
    assert bridge.played.stops == stops + 5


def test_a_stepper_is_slowed_down_when_its_host_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Playing(sends="acceleration", full=12.0, fastest=2.0)
    bridge.measure(*range(0, 4000, 400))  # 1 m/s
    bridge.drive(0, monkeypatch)
    bridge.measure(4000, 4400)
    assert bridge.played.sent[-1] == pytest.approx(-10, rel=0.1)


@pytest.mark.parametrize("latency", [0, 2])
@pytest.mark.parametrize("speed", [-0.3, 0.012])
def test_a_stepper_is_left_standing(speed: float, latency: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its board takes accelerations, and stops with the acceleration 0, at which it would keep its speed."""
    bridge = Playing(sends="acceleration", full=12.0, fastest=2.0)
    bridge.drive(0, monkeypatch)
    x, asked = 0.0, [0.0] * (latency + 1)

    def roll(periods: int) -> None:
        nonlocal x, speed
        for _ in range(periods):
            stops = bridge.played.stops
            bridge.measure(round(x / 25e-6))
            asked.append(0.0 if bridge.played.stops > stops else (bridge.played.sent or [0.0])[-1])
            if bridge.played.stops > stops:
                bridge.played.sent.append(0.0)  # what a stop means to this board
            acceleration = asked[-1 - latency]
            x += speed * 0.01 + acceleration * 0.01**2 / 2
            speed += acceleration * 0.01

    roll(10)
    bridge._stand_in.armed = False
    roll(400)
    assert abs(speed) < 2e-4  # m/s
    sent, stops = len(bridge.played.sent), bridge.played.stops
    roll(100)
    assert (len(bridge.played.sent), bridge.played.stops) == (sent, stops)


@pytest.mark.parametrize("period_us", [10_000, 50_000])
def test_a_stepper_that_creeps_at_motor_0_comes_to_rest(
    period_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With three decimals, the damping of 0.25 mm/s is sent as 0."""
    monkeypatch.setitem(globals(), "PERIOD_US", period_us)
    bridge, x, speed, seconds = (
        Playing(sends="acceleration", full=12.0, damping=2.0),
        0.0,
        0.01,
        period_us / 1e6,
    )
    bridge.drive(0, monkeypatch)
    monkeypatch.setattr(StandIn, "is_idle", lambda stand_in, now_us: False)
    for _ in range(round(5 / seconds)):
        bridge.measure(round(x / 25e-6))
        acceleration = round(bridge.played.sent[-1], 3)
        x += speed * seconds + acceleration * seconds**2 / 2
        speed += acceleration * seconds
    assert abs(speed) < 1e-4  # m/s


def test_a_stepper_whose_fine_encoder_flickers_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    fine = RIG.model_copy(update={"cart_nanometres_per_count": 1000})
    monkeypatch.setitem(globals(), "RIG", fine)
    bridge = Playing(sends="acceleration", full=12.0)
    bridge.drive(0, monkeypatch)
    bridge.measure(*[4, -4] * 30)
    bridge._stand_in.armed = False
    bridge.measure(*[4, -4] * 3)
    sent = len(bridge.played.sent)
    bridge.measure(*[4, -4] * 30)
    assert len(bridge.played.sent) == sent


def test_a_stepper_whose_count_froze_is_slowed_down_by_what_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Playing(sends="acceleration", full=12.0, fastest=2.0)
    bridge.drive(0, monkeypatch)
    bridge.measure(*range(0, 800, 80))  # 0.2 m/s
    bridge._stand_in.armed = False
    monkeypatch.setattr(StandIn, "is_active", True)
    bridge.drive(10, monkeypatch)
    bridge._stand_in.armed = False
    bridge.measure(*[720] * 60)  # 0.5 m/s^2 for 0.6 s
    bridge.played.sent.clear()
    monkeypatch.setattr(StandIn, "is_active", False)
    bridge.measure(*[720] * 200)
    assert sum(bridge.played.sent) * 0.01 == pytest.approx(-0.4, abs=0.1)  # m/s


def test_a_board_whose_clock_wraps_has_not_restarted() -> None:
    bridge = Playing()
    for number in range(-5, 5):
        bridge.now += PERIOD_US
        bridge._pass(Measurement(0, 0, number * PERIOD_US % 2**32))
    assert bridge.played.bad == 0
    assert bridge._last is not None
    assert bridge._last.us == 2**32 + 4 * PERIOD_US


def test_a_stepper_that_takes_speeds_is_slowed_down_and_not_stopped_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bridge = Playing(sends="speed", full=10.0, fastest=1.0)
    bridge.measure(0)
    bridge.drive(255, monkeypatch)
    bridge.measure(*[0] * 6)
    bridge.drive(0, monkeypatch)
    bridge.played.sent.clear()
    stops = bridge.played.stops
    bridge.measure(*[0] * 8)
    assert bridge.played.sent == pytest.approx([0.4, 0.3, 0.2, 0.1], abs=1e-6)
    assert bridge.played.stops > stops


@pytest.mark.parametrize("sends", ["speed", "acceleration"])
def test_a_stepper_that_rolls_is_slowed_down_when_its_homing_begins(
    sends: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge = Playing(sends=sends, full=4.0, fastest=1.0, homing="hand")
    bridge.measure(*range(0, 4000, 400))  # 1 m/s
    bridge.drive(255, monkeypatch)
    bridge.measure(*range(4000, 16_000, 400))
    bridge.home(monkeypatch)
    before = bridge.played.sent[-1]
    bridge.measure(16_000)
    assert bridge.played.sent[-1] == (pytest.approx(before - 0.04) if sends == "speed" else -4)


@pytest.mark.parametrize("board_homes", [True, False])
def test_homing_begins_at_rest_whatever_speed_was_sent_before(
    board_homes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stepper that takes speeds, whose homing begins before it was slowed down."""
    bridge = Playing(sends="speed", full=4.0, fastest=1.0, homing="board" if board_homes else "hand")
    bridge.measure(0)
    bridge.drive(255, monkeypatch)
    bridge.measure(*[0] * 30)
    assert bridge.played.sent[-1] > 0.9
    bridge.home(monkeypatch)
    bridge._stand_in.board_homes = board_homes
    bridge.measure(*[0] * 40)
    bridge._stand_in.board_homes = False
    bridge.measure(0)
    assert bridge.played.sent[-1] == 0


@pytest.mark.parametrize("has_time", [True, False])
def test_a_late_line_faults_no_cart(has_time: bool) -> None:
    """One that came 9 ms late, or a second of lines that came 15 ms late, and then one that came in time."""
    bridge = Playing(sends="value", full=255)
    for number in range(200):
        late = 15_000 * (has_time and 40 <= number < 140) + 9_000 * (number == 20)
        bridge.now = number * PERIOD_US + late
        cart = 40 * max(0, number - 12)
        bridge._pass(Measurement(cart, 2048 + number % 2, number * PERIOD_US if has_time else None))
        if number == 10:
            bridge._stand_in.armed = bridge._stand_in.homed = True
            bridge._stand_in._limits.release()
    assert (bridge._stand_in.fault, bridge.played.bad) == (Fault.NONE, 0)


def test_a_board_that_measures_far_more_often_than_at_first_is_refused() -> None:
    bridge = Playing()

    def measure_fast() -> None:
        for number in range(3000):
            bridge.now = number * PERIOD_US // 5
            bridge._pass(Measurement(0, 0, None))

    with pytest.raises(LinkError, match="x measures far more often than when it was opened"):
        measure_fast()


def test_the_brake_allows_for_the_time_to_the_next_line() -> None:
    """The farther apart the lines, the earlier it begins: at 1 m/s a line of 20 ms costs 20 mm."""
    begun = {}
    for look_us in (0, 20_000):
        limits = TrackLimits(RIG, 0, 3, look_us)
        half = RIG.encoders.cart_counts(RIG.half_span)
        for count in range(0, half, 40):  # 1 m/s, a sample a millisecond
            limits.sample(1000 * (count // 40), count, 0)
            limits.apply(1000 * (count // 40), count, 0, half, armed=True)
            if limits.brake:
                begun[look_us] = count * RIG.encoders.metres
                break
    assert begun[0] - begun[20_000] == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("board_us", [10_000, 30_000, 50_000])
@pytest.mark.parametrize("begin", [-0.3, -0.25, -0.2, -0.15, -0.1, 0.0])  # m
def test_full_motor_touches_no_stop_however_seldom_the_board_measures(begin: float, board_us: int) -> None:
    cart = completed(choice("cart/ip02"))
    rig = hardware_of(cart)
    board = StandIn(settings(), rig, board_us, Played(settings(), rig.encoders), LEVER)
    board.homed, now_us, x, speed, motor = True, 0, begin, 0.0, 0
    middle = board._zeros.middle
    board.tick(now_us, middle + rig.encoders.cart_counts(x), 0)
    board.receive(encode_frame(Start(), 1)[:-1], now_us)
    pole = 0
    while board.armed and now_us < 8_000_000:
        board.receive(encode_frame(SetMotor(255, board._ticks), 2)[:-1], now_us)
        board.drive(now_us)
        motor = board.motor
        for _ in range(board_us // 1000):
            push = max(0.0, cart["force_linear"] * abs(motor) + cart["force_offset"])
            friction = cart["cart_viscous"] * speed + math.copysign(cart["cart_coulomb"], speed)
            speed += 1e-3 * (math.copysign(push, motor) - friction) / cart["cart_mass"]
            x += 1e-3 * speed
            assert x < rig.half_span
        now_us, pole = now_us + board_us, 10 - pole  # not frozen
        board.tick(now_us, middle + rig.encoders.cart_counts(x), pole)
    assert x > rig.half_span / 2


def test_a_time_that_has_not_come_yet_is_damaged_and_costs_one_line() -> None:
    bridge = Playing(sends="value", full=255)
    bridge.measure(*range(10))
    bridge._stand_in.homed = True
    bridge.now += PERIOD_US
    bridge._pass(Measurement(10, 0, bridge.now + 600_000))
    assert bridge.played.bad == 1
    assert bridge.measure(*range(11, 20)) == [True] * 9
    assert bridge._stand_in.homed


def test_a_board_that_homes_may_set_its_count() -> None:
    bridge = Playing(homing="board", sends="acceleration", full=12.0)
    bridge.measure(*range(-12000, -11000, 100))
    stand_in = bridge._stand_in
    stand_in.board_homes, sent = True, [*bridge.played.sent]
    assert bridge.measure(0, 0, 0, 10) == [False, False, True, True]
    assert bridge._stand_in is stand_in
    assert bridge.played.sent == sent


def test_a_board_whose_homing_is_broken_off_is_stopped_before_it_is_slowed_down() -> None:
    """While it homes it may take no commands, and one line may be damaged."""
    bridge = Playing(homing="board", sends="acceleration", full=12.0)
    bridge._stand_in.board_homes = True
    bridge.measure(*range(0, -4000, -40))
    stops, sent = bridge.played.stops, [*bridge.played.sent]
    bridge._stand_in.board_homes = False
    bridge._command()
    assert (bridge.played.stops, bridge.played.sent) == (stops + 1, sent)
    bridge.measure(-4040)
    assert (bridge.played.stops, bridge.played.sent) == (stops + 2, sent)
    bridge.measure(-4080, -4120)
    assert bridge.played.stops == stops + 2
    assert bridge.played.sent[-1] > 0  # it still runs to the left


def test_a_count_that_is_set_elsewhere_ends_the_homing() -> None:
    bridge = Playing()
    bridge.measure(8000, 8001)
    bridge._stand_in.homed = True
    assert bridge.measure(0, 0) == [False, False]  # a damaged line or two
    assert bridge._stand_in.homed
    assert bridge.measure(8002) == [True]
    assert bridge.measure(*[0] * CONFIRMED) == [False] * (CONFIRMED - 1) + [True]
    assert not bridge._stand_in.homed


LOW, HIGH = 60, 3860  # of 4096: 26 degrees are not measured


def seen_from_start(
    bridge: Playing, counts: Sequence[float], reversed_by: int = 1, period_us: int = PERIOD_US
) -> list[int]:
    """Let the pole be at true counts, a period each; return how far the bridge saw it turn."""
    seen: list[int] = []
    for number, count in enumerate(counts):
        bridge.now += period_us
        reading = round(reversed_by * count) % RIG.pole_counts_per_turn
        if not LOW <= reading <= HIGH:
            reading = 4095 if number % 2 else 0  # a dead zone gives anything
        bridge._pass(Measurement(0, reading, bridge.now))
        seen.append(bridge._counts[1])
    return [each - seen[0] for each in seen]


def test_a_range_of_the_pole_is_a_part_of_a_turn() -> None:
    with pytest.raises(
        ConfigError, match=r"^plant.pole_range covers the whole turn of 4096 counts: leave it out$"
    ):
        Playing(pole_range=[0, 4096])
    with pytest.raises(ValueError, match=r"pole_range=\[4035, 60\]: give the smaller count first"):
        settings(pole_range=[4035, 60])


@pytest.mark.parametrize("reversed_by", [1, -1])
@pytest.mark.parametrize("speed", [-12.0, 4.0])  # rad/s
def test_a_pole_is_carried_through_the_dead_zone_of_its_potentiometer(speed: float, reversed_by: int) -> None:
    bridge = Playing(pole_range=[LOW, HIGH], pole_reversed=reversed_by < 0)
    turns = speed / math.tau * PERIOD_US * 1e-6
    true = [1000 * reversed_by + each * turns * RIG.pole_counts_per_turn for each in range(400)]
    turned = [each - true[0] for each in true]
    assert seen_from_start(bridge, true, reversed_by) == pytest.approx(turned, abs=6)
    assert bridge.played.bad == 0


@pytest.mark.parametrize("period_us", [1_000, PERIOD_US])
def test_a_pole_that_turns_back_in_the_dead_zone_is_kept_in_it(period_us: int) -> None:
    """It comes out where it went in, after 0.16 s; the estimate is at most the zone away."""
    bridge = Playing(pole_range=[LOW, HIGH])
    bridge._board_us = period_us
    bridge._stand_in.armed = bridge._stand_in.homed = True
    times = [0.17 * each / (170_000 // period_us) for each in range(170_000 // period_us)]
    true = [3840 + 2400 * t - 15_000 * t * t for t in times]
    seen = seen_from_start(bridge, true, period_us=period_us)
    assert max(seen) <= 4096 + LOW - 3840
    assert seen[-1] == pytest.approx(true[-1] - true[0], abs=1)
    assert (bridge.played.bad, bridge._stand_in.fault) == (0, 0)


def test_noise_at_the_edge_of_the_dead_zone_carries_no_pole_out_of_it() -> None:
    bridge = Playing(pole_range=[LOW, HIGH])
    seen = seen_from_start(bridge, [3860, 3857, *[4000] * 15])
    assert set(seen[2:]) == {0}  # 3860, where the zone begins


def test_a_damaged_line_from_the_dead_zone_is_refused_and_faults_nothing() -> None:
    bridge = Playing(pole_range=[LOW, HIGH])
    seen_from_start(bridge, [3800, 3840, 4000])
    bridge._stand_in.armed = bridge._stand_in.homed = True
    bridge._pass(Measurement(0, 4000, bridge.now - 10_000_000))
    assert (bridge.played.bad, bridge._stand_in.fault, bridge._stand_in.armed) == (1, 0, True)


def test_a_pole_that_is_lost_faults_an_armed_cart_which_is_still_measured() -> None:
    bridge = Playing(pole_range=[LOW, HIGH], sends="value")
    seen_from_start(bridge, [3800, 3840, *[4000] * 10])
    assert bridge._stand_in.fault == 0
    bridge._stand_in.armed = bridge._stand_in.homed = True
    seen_from_start(bridge, [4000] * 30)
    assert bridge._stand_in.fault == Fault.POLE_ENCODER
    assert not bridge._stand_in.armed
    assert bridge.played.bad == 0
    assert bridge._last is not None
    assert bridge._last.us == bridge.now


@pytest.mark.parametrize("bad", [math.nan, 1.5, None, "1"])
def test_a_measurement_without_whole_counts_is_refused(bad: Any) -> None:
    bridge = Playing()
    assert bridge.measure(0, bad, 1) == [True, False, True]
    assert "is not in whole counts" in bridge.played.why_bad
    assert bridge.measure(0, 2**32 - 6, 1) == [True, False, True]
    assert "has a count beyond 32 bits" in bridge.played.why_bad


def test_no_command_is_infinite() -> None:
    bridge = Playing()
    with pytest.raises(LinkError, match="the command nan is not finite"):
        bridge._send_value(math.nan)


def test_a_driver_that_raises_anything_leaves_a_stopped_board() -> None:
    bridge = Playing(sends="acceleration", full=12.0)
    bridge.played.script = [Measurement(0, 0, 0), ValueError("oops"), ValueError("again")]
    with pytest.raises(LinkError, match=r"plant\.driver=.*:TextDriver failed: ValueError: oops"):
        bridge.run_and_end()
    assert bridge.played.stops >= STOPS


def test_a_signal_while_the_end_begins_leaves_a_stopped_board(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, raised = Playing(sends="value", full=255), iter([KeyboardInterrupt()])

    def ignore(number: int, handler: Any) -> None:
        for error in raised:  # once, by the handler of a signal that came just before
            raise error

    bridge.played.script = [LinkError("cable")]
    monkeypatch.setattr("cartpole_rl.plants.drivers.bridge.signal.signal", ignore)
    with pytest.raises(KeyboardInterrupt), bridge:
        bridge.run_and_end()
    assert bridge.played.stops >= STOPS


def test_a_driver_that_returns_something_else_is_named() -> None:
    bridge = Playing()
    bridge.played.script = [(0, 0, 0)]
    with pytest.raises(LinkError, match=r":TextDriver: read returned \(0, 0, 0\); return a Measur"):
        bridge.run_and_end()


def hanging(until: Event) -> Callable[[float], None]:
    """Return a call of a driver that does not return before the board is stopped."""

    def hang(argument: float) -> None:
        raise LinkError("stopped" if until.wait(30) else "still on")

    return hang


def test_a_read_that_does_not_return_leaves_no_motor_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, stopped = Playing(), Event()
    bridge.measure(0, 0)
    bridge._stand_in.armed = bridge._stand_in.homed = True
    bridge._stand_in._line.hold(200)
    monkeypatch.setattr(bridge, "_now_us", lambda: Bridge._now_us(bridge))
    monkeypatch.setattr(bridge.played, "stop", stopped.set)
    monkeypatch.setattr(bridge.played, "read", hanging(stopped))
    with pytest.raises(LinkError, match=r"^stopped$"):
        bridge.run_and_end()
    assert bridge._stand_in.motor == 0


@pytest.mark.parametrize("hangs", ["read", "send"])
def test_stopping_a_board_goes_on_while_the_reading_thread_hangs(
    hangs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge, stopped, stops = Playing(), Event(), iter(range(10**6))
    bridge.measure(0, 0)
    bridge.drive(200, monkeypatch)
    monkeypatch.setattr(bridge, "_now_us", lambda: Bridge._now_us(bridge))
    monkeypatch.setattr(bridge, "_wait", lambda now_us: bridge.played.stop())

    def stop() -> None:
        if next(stops) == 0:
            raise OSError("no buffer space, once")
        stopped.set()

    monkeypatch.setattr(bridge.played, "stop", stop)
    monkeypatch.setattr(bridge.played, hangs, hanging(stopped))
    bridge.played.script = [Measurement(0, 0, 3 * PERIOD_US)]
    with pytest.raises(LinkError, match=r"^stopped$"):
        bridge.run_and_end()


def test_a_stepper_is_slowed_down_while_the_reading_thread_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, stopped, fails = Playing(sends="acceleration", full=12.0, fastest=2.0), Event(), iter([True])
    bridge.measure(*range(0, 4000, 400))  # 1 m/s
    monkeypatch.setattr(bridge, "_now_us", lambda: bridge.now + Bridge._now_us(bridge))
    sent: list[float] = []

    def send(value: float) -> None:
        if next(fails, False):
            raise OSError("no buffer space, once")
        sent.append(value)

    monkeypatch.setattr(bridge.played, "send", send)
    monkeypatch.setattr(bridge.played, "stop", stopped.set)
    monkeypatch.setattr(bridge.played, "read", hanging(stopped))
    with pytest.raises(LinkError, match=r"^stopped$"):
        bridge.run_and_end()
    assert sent  # it was not stopped at once, which would let it roll


def test_a_command_that_does_not_return_keeps_nobody_from_stopping_the_board() -> None:
    bridge = Playing()
    bridge._lock.acquire()  # as the thread that hangs in `send`
    with pytest.raises(LinkError, match=r":TextDriver: send, stop or home did not return for 0\.5 s"):
        bridge.run_and_end()
    assert bridge.played.stops == STOPS


@pytest.mark.parametrize("why", ["is the cart unplugged?", ""])
def test_a_board_that_takes_no_stop_at_the_end_is_told(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Playing()
    bridge.played.script = [LinkError(why) if why else KeyboardInterrupt()]
    monkeypatch.setattr(bridge.played, "stop", unable)
    told = re.escape(why or "OSError: no bus")
    with pytest.raises(LinkError, match=rf"{told}; .* its motor may still be on"):
        bridge.run_and_end()


def unable() -> None:
    raise OSError("no bus")


def test_two_signals_at_once_leave_a_stopped_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """A logout sends SIGTERM and SIGHUP; the second one must not interrupt what the first one begins."""
    bridge, both = Playing(), (signal.SIGTERM, signal.SIGHUP)

    def session_ends(timeout: float) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, both)
        for number in both:
            signal.raise_signal(number)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, both)

    monkeypatch.setattr(bridge.played, "read", session_ends)
    with until_stopped():
        bridge.run_and_end()
    assert bridge.played.stops == STOPS


def test_a_board_is_stopped_before_anything_else() -> None:
    bridge = Playing()
    bridge.played.script = [Measurement(0, 0, PERIOD_US * number) for number in range(25)]
    bridge.listen()
    assert bridge.played.stops == STOPS  # the first may be damaged
    bridge.measure(0, 0, 0, 0)
    assert bridge.played.stops == 2 * STOPS
    assert not bridge.played.sent


def tell(bridge: Playing, *messages: Message) -> None:
    for number, message in enumerate(messages):
        bridge._obey(encode_frame(message, number, Flags(0)).removesuffix(b"\0"))


def test_a_stop_right_after_home_reaches_a_board_that_homes_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its motor value is 0 before and after, and no measurement came between them."""
    bridge = Playing(homing="board")
    monkeypatch.setattr(Played, "home", lambda driver: None)
    bridge.measure(*[0] * 10)
    stops = bridge.played.stops
    tell(bridge, Home(), Stop())
    assert bridge.played.stops == stops + 1
    bridge.measure(0, 0, 0, 0)
    assert bridge.played.stops == stops + STOPS


def test_a_stop_that_the_board_did_not_get_is_not_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, sent = Playing(), []
    monkeypatch.setattr(bridge, "_send", sent.append)
    monkeypatch.setattr(bridge.played, "stop", unable)
    with pytest.raises(OSError, match="no bus"):
        tell(bridge, Stop())
    assert not sent


@pytest.mark.parametrize(
    ("period_us", "measurements", "why"),
    [
        (10, 25, r"x measures every 0\.01 ms by its time; .*correct time_unit"),
        (10_000_000, 25, r"x measures every 1e\+04 ms by its time; .*correct time_unit"),
        (PERIOD_US, 19, "only 19 measurements came from x"),
    ],
)
def test_a_board_whose_period_cannot_be_learnt_is_refused(
    period_us: int, measurements: int, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge = Playing(connect_timeout=0.1)
    monkeypatch.setattr("cartpole_rl.plants.drivers.bridge.LISTENED_TO_ARRIVALS", 0.0)
    bridge.played.script = [Measurement(0, 0, period_us * number) for number in range(measurements)]
    with pytest.raises(LinkError, match=why):
        bridge.listen()


def test_a_control_period_that_fits_is_named_whatever_was_asked_for() -> None:
    bridge = Playing()
    bridge._begin(60_000)
    with pytest.raises(ConfigError, match=r"control_period=0\.1: .*; give control_period=0\.06$"):
        bridge._stand_in.check_period(100_000)


@pytest.mark.parametrize(("true_us", "unit_us"), [(1667, 1000), (3333, 1000), (10_000, 1), (16_667, 1000)])
def test_the_period_is_learnt_from_coarse_stamps_and_in_spite_of_lost_lines(
    true_us: int, unit_us: int
) -> None:
    bridge = Playing()
    stamps = [number * true_us // unit_us * unit_us for number in range(30) if number not in (7, 19, 20)]
    bridge.played.script = [Measurement(0, 0, stamp) for stamp in stamps]
    assert bridge._learn_period() == pytest.approx(true_us, rel=0.03)


def test_neither_a_moment_without_a_measurement_nor_a_damaged_stamp_hides_the_period() -> None:
    bridge = Playing()
    measured = [Measurement(0, 0, PERIOD_US * number) for number in range(60)]
    measured[12] = Measurement(0, 0, 7_000_000)
    bridge.played.script = [each if number % 5 else None for number, each in enumerate(measured)]
    assert bridge._learn_period() == PERIOD_US


def test_a_clock_that_stands_is_refused() -> None:
    bridge = Playing()
    bridge.played.script = [Measurement(0, 0, number // 3) for number in range(25)]
    with pytest.raises(LinkError, match="the time of x does not advance"):
        bridge._learn_period()


def test_measurements_without_a_time_that_come_in_bursts_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = Playing()
    seconds = [0.016 * (number // 4) + 1e-5 * (number % 4) for number in range(400)]
    bridge.played.script = [Measurement(0, 0, None) for _ in seconds]
    clock = iter(seconds)
    monkeypatch.setattr(bridge, "_now_us", lambda: round(1e6 * next(clock)))
    monkeypatch.setattr("cartpole_rl.plants.drivers.bridge.LISTENED_TO_ARRIVALS", 0.0)
    with pytest.raises(LinkError, match="come in bursts, so nobody knows when each was made"):
        bridge.listen()


@pytest.mark.parametrize(
    ("given", "rig", "why"),
    [
        ({"homing": "board", "home_position": 0.3}, {}, "home_position=0.3 is beyond the track"),
        ({"homing": "board", "home_position": -300.0}, {}, "home_position=-300 is beyond the track"),
        ({"homing": "stops"}, {"left_switch": 1}, "cart= has end switches, which only its board reads; give"),
    ],
)
def test_what_the_board_cannot_do_is_refused_before_anything_is_sent(
    given: dict[str, Any], rig: dict[str, int], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge = Playing(**given)
    bridge._hardware = RIG.model_copy(update=rig)
    monkeypatch.setattr(Played, "home", lambda driver: None)
    with pytest.raises(ConfigError, match=why):
        bridge.listen()
    assert (bridge.played.sent, bridge.played.stops) == ([], 0)


def test_a_driver_that_cannot_home_is_not_asked_to() -> None:
    with pytest.raises(ConfigError, match="the driver has no method home"):
        Playing(homing="board").listen()


def test_the_brake_knows_the_pole() -> None:
    assert Playing()._stand_in._limits._lever == LEVER
    large = {**choice("cart/ip02"), **choice("pole/large")["choices"]["large"]}
    assert lever_um(completed(large)) == pytest.approx(81_400, rel=0.01)
    assert lever_um({**completed(large), "backdrivability": 0.0}) == 0


def test_a_board_that_ignores_the_line_to_home_is_noticed() -> None:
    stand_in = Playing(homing="board")._stand_in
    waiting, still = stand_in._until_board_rests(Reading(8000, 0, PERIOD_US)), Reading(8000, 0, PERIOD_US)
    next(waiting)
    with pytest.raises(HomingError, match="the cart did not move"):
        deque((waiting.send(still) for _ in range(1000)), maxlen=0)


def test_no_acceleration_exceeds_the_largest() -> None:
    """At the fastest speed the damping adds 20 m/s^2, as in simulation; a faster one is not a stepper's."""
    commands = MotorCommands(settings(sends="acceleration", full=-12.0, damping=20.0))
    for speed in (0.9, -4.0):
        commands.measured(speed, 0.0)
        assert abs(commands.value(-255, 0.0)) <= 12 + 20


def test_a_stepper_is_not_driven_beyond_its_fastest_speed() -> None:
    commands = MotorCommands(settings(sends="acceleration", full=12.0, fastest=1.0, damping=0.0))
    commands.measured(1.2, 0.0)
    assert commands.value(255, 0.0) == 0
    assert commands.value(-255, 0.0) == -12
