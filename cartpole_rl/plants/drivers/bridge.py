"""The bridge: this computer stands in for our firmware on a board that has its own.

The bridge reads the board by a driver, applies the rules of the firmware to each measurement (limits, brake,
watchdog, faults, late commands: `cartpole_rl.emulator.firmware`), and speaks the protocol on a port that the
commands open like that of any cart. It is a process of its own: if the command that drives is killed, the
watchdog here still sets the motor to 0. Nothing stands in for the bridge itself, and it can act only as often
as the board sends. docs/my-cart.md compares the two.

    board  --lines-->  driver  -->  StandIn (rules)  --frames-->  SerialCart, in the command that drives
"""

import math
import signal
import time
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from operator import index
from statistics import mean, median
from threading import Event, Lock, Thread
from typing import Self

from cartpole_rl.emulator.firmware import LARGEST_MOTOR, WATCHDOG_PERIODS, Firmware
from cartpole_rl.emulator.guards import FASTEST_CART, FASTEST_POLE, LONGEST_US, SHORTEST_US
from cartpole_rl.emulator.homing import Homing, HomingError, Reading, Window, Zeros
from cartpole_rl.emulator.link import Channel
from cartpole_rl.errors import CartPoleError, ConfigError, LinkError, reason_of
from cartpole_rl.plants.drivers.driver import Driver, Measurement, unwrapped
from cartpole_rl.plants.drivers.potentiometer import Potentiometer
from cartpole_rl.plants.serial.link import now
from cartpole_rl.plants.settings import BoardSettings
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.signals import ending_signals
from cartpole_rl.wire.messages import MOST_COUNTS, Fault, Home, Message, Reason, SetPeriod, State, Stop

LISTENED = 25  # measurements by which a board's period is known
FASTEST_BOARD_US = 200  # between two measurements; faster ones are milliseconds, taken for microseconds
LISTENED_TO_ARRIVALS = 1.0  # s for a board that does not send its time
FEW_LOST = 3  # gaps between two measurements, in medians: in longer ones the board was not heard
PERIOD_TOLERANCE = 0.05  # share
SAMPLES = 3  # measurements by which the limits know the speed
LEAK = 0.01  # largest difference between the rates of the two clocks
LATE_PERIODS = 1.5  # without a measurement, after which the rules look at the clock alone
MOST_BAD = 50  # damaged measurements more than whole ones
CONFIRMED = 3  # implausible measurements in a row that fit each other: the board counts from elsewhere now
HUNG_PERIODS = 2  # control periods, after which a `read` that has not returned hangs
LONGEST_CALL = 0.5  # s that a driver may take for a command
SILENT_PERIODS = 3  # control periods without a measurement, after which the motor is off
STOPS = 3  # lines that stop a board; the first may be damaged
STOPPING = 2.0  # s that a cart which does not stop at the value 0 is given to stop
STANDS = 1e-3  # m/s, of a cart whose speed is known from what was sent alone
LARGEST_CREEP = 0.02  # m/s: more is no flicker of the count of a cart that stands
STANDS_US, STANDS_WITHIN = 500_000, 25e-6  # m, or one count: a cart that stays so near for this time stands
SETTLING = 0.1  # s: how fast such a cart is braked
EARLY_US = 50_000  # a time stamp that lies so far after the arrival is damaged
MOST_AHEAD_US = 2_000_000  # of a measured time, before the board is taken for a faster one than at first
LONGEST_STEP = 0.2  # s without a command, for which the last one counts
BOARD_RESTS_US, BOARD_STANDS = 1_500_000, 1e-3  # us without more motion than this, m: its homing has ended
BOARD_ZERO = 2e-3  # m: a board that stands so near its zero may home without moving
MOST = 2**62  # counts: an encoder has no dead zone
LONGEST_BOARD_HOMING = 60_000_000  # us


class BoardClock:
    """The board's clock in terms of this computer's, by the arrivals of its measurements.

    A measurement can arrive late but never early: the earliest arrival tells by how much the clocks differ.
    So one that waited in a buffer is known to be old. Two measurements count as at least half a board period
    apart, even if they arrive together.
    """

    def __init__(self, board_us: int) -> None:
        self._shortest = board_us // 2
        self._ahead: float | None = None
        self._last = self._measured = 0  # stamp, us, and when it was made

    def is_early(self, stamp_us: int, arrived_us: int) -> bool:
        """Return True if a measurement would have arrived before it was made: its time is damaged."""
        return self._ahead is not None and stamp_us + self._ahead > arrived_us + EARLY_US

    def measured_us(self, stamp_us: int, arrived_us: int) -> int:
        """Return when a measurement was made, us of this computer's clock, by its `stamp_us`."""
        ahead = float(arrived_us - stamp_us)
        first = self._ahead is None
        if self._ahead is not None:
            ahead = min(ahead, self._ahead + LEAK * max(0, stamp_us - self._last))
        self._ahead, self._last = ahead, stamp_us
        measured = round(stamp_us + ahead)
        self._measured = measured if first else max(measured, self._measured + self._shortest)
        return self._measured


class StandIn(Firmware):
    """The firmware's rules for a board with its own firmware, whose measurements set the pace."""

    def __init__(
        self, settings: BoardSettings, hardware: Hardware, board_us: int, driver: Driver, lever: int
    ) -> None:
        """`board_us` is the time between two measurements, `lever` that of `TrackLimits`, um."""
        super().__init__(lambda: 0, lever_um=lever, hardware=hardware, samples=SAMPLES, look_us=board_us)
        self._settings, self._driver, self._board_us = settings, driver, board_us
        self.board_homes = False  # the board moves the cart by itself
        self.every = math.ceil(SHORTEST_US / board_us)  # measurements a control period
        self.period_us = self.every * board_us
        self._stamp_us = 0

    def check_period(self, period_us: int) -> int:
        """Return the measurements in a control period. Raises ConfigError if they do not make one."""
        every = max(1, round(period_us / self._board_us))
        if abs(every * self._board_us / period_us - 1) > PERIOD_TOLERANCE:
            below = period_us // self._board_us
            periods = [n * self._board_us for n in (below, below + 1)]
            fitting = " or ".join(f"{us / 1e6:.4g}" for us in periods if SHORTEST_US <= us <= LONGEST_US)
            raise ConfigError(
                f"control_period={period_us / 1e6:g}: the board measures every {self._board_us / 1e3:.3g} "
                f"ms; give control_period={fitting}"
            )
        return every

    def measure(self, now_us: int, measured_us: int, stamp_us: int, counts: tuple[int, int]) -> list[bytes]:
        """End a period with a measurement of the board; return the frames to send."""
        self._expire(now_us)
        self._stamp_us = stamp_us
        return self.tick(measured_us, *counts)

    def drive(self, now_us: int) -> None:
        """Bring the values that are due into force, within the limits: the next measurement may be far."""
        super().drive(now_us)
        if not self.homing:
            self._apply_limits(now_us)

    def wait(self, now_us: int) -> None:
        """Apply the rules of the clock: no measurement comes."""
        self._expire(now_us)

    def recount(self) -> None:
        """Let the board, which homes, count from elsewhere."""
        self._reset_watches()

    def lose_pole(self) -> None:
        """Fault a driven cart whose pole is not measured any more."""
        if self.armed or self.homing:
            self._latch(Fault.POLE_ENCODER)

    @property
    def is_active(self) -> bool:
        """True while the motor may be on."""
        return self.armed or self.homing or self.motor != 0

    def is_idle(self, now_us: int) -> bool:
        """Return True while nothing drives an armed cart: the host is late, and no limit brakes it."""
        return self.armed and self.motor == 0 and now_us >= self._expires_us

    def _objection(self, message: Message, now_us: int) -> Reason | None:
        if isinstance(message, SetPeriod):
            try:
                self.check_period(message.period_us)
            except (ConfigError, ZeroDivisionError):
                return Reason.OUT_OF_RANGE
        return super()._objection(message, now_us)

    def _carry_out(self, message: Message, now_us: int) -> None:
        super()._carry_out(message, now_us)
        self._expires_us = min(self._expires_us, now_us + WATCHDOG_PERIODS * self.period_us)
        if isinstance(message, SetPeriod):
            self.every = self.check_period(message.period_us)

    def _state(self, cart: int, pole: int) -> State:
        return replace(super()._state(cart, pole), time_us=self._stamp_us % 2**32)

    def _brake_blindly(self, now_us: int) -> None:
        """Leave it to `MotorCommands`, which knows the speed of a cart that it gave one."""
        if self._settings.sends == "value":
            super()._brake_blindly(now_us)

    def _home(self) -> Generator[int, Reading, Zeros]:
        homing = Homing(self._hardware)
        if self._settings.homing == "stops":
            return homing.home()
        return (
            self._homed_by_board(homing) if self._settings.homing == "board" else self._homed_by_hand(homing)
        )

    def _homed_by_hand(self, homing: Homing) -> Generator[int, Reading, Zeros]:
        """Wait until the pole hangs still. A person has put the cart in the middle."""
        hanging = yield from homing.wait_until_still((yield 0))
        reading = yield 0
        return self._zeros_about(reading.cart, hanging)

    def _homed_by_board(self, homing: Homing) -> Generator[int, Reading, Zeros]:
        """Let the board home, move the cart to the middle, and wait until the pole hangs still."""
        self.board_homes = True
        try:
            self._driver.home()
            reading = yield from self._until_board_rests((yield 0))
        finally:
            self.board_homes = False
        middle = reading.cart - self._hardware.encoders.cart_counts(self._settings.home_position)
        return self._zeros_about(middle, (yield from homing.settle(middle, reading)))

    def _until_board_rests(self, reading: Reading) -> Generator[int, Reading, Reading]:
        window, elapsed, first, moved = Window(BOARD_RESTS_US), 0, reading.cart, False
        stands = max(1, self._hardware.encoders.cart_counts(BOARD_STANDS))
        while elapsed < LONGEST_BOARD_HOMING:
            window.add(reading.cart, reading.us)
            moved |= abs(reading.cart - first) > stands
            if window.spread <= stands:
                if moved or abs(reading.cart) <= self._hardware.encoders.cart_counts(BOARD_ZERO):
                    return reading
                raise HomingError("the cart did not move: plant.home_line does not start its homing")
            reading = yield 0
            elapsed += reading.us
        raise HomingError(f"the board's own homing did not end within {LONGEST_BOARD_HOMING / 1e6:.0f} s")

    def _zeros_about(self, middle: int, hanging: int) -> Zeros:
        half_span = self._hardware.encoders.cart_counts(self._hardware.half_span)
        return Zeros(middle - half_span, middle + half_span, hanging)


class MotorCommands:
    """The command for a motor value, in the unit that the board takes: `settings.sends`.

    A board that takes accelerations lets the cart roll at 0. Its speed is then needed also while nothing is
    measured: it follows from what was sent.
    """

    def __init__(self, settings: BoardSettings, creep: float = STANDS) -> None:
        """`creep` m/s: a cart whose count stands is at rest if it is slower; else its count is dead."""
        self._creep = max(STANDS, creep)
        self._sends, self._damping = settings.sends, settings.damping
        self._size, self._sign = abs(settings.full), math.copysign(1.0, settings.full)
        self._fastest = settings.fastest
        self._speed = 0.0  # m/s, of the cart; sends=speed: the one that was sent last
        self._acceleration = 0.0  # m/s^2, that was sent last
        self._now = 0.0  # s, until which the speed was computed

    def measured(self, speed: float, now: float) -> None:
        """Note the measured speed of a cart whose count has changed."""
        if self._sends == "acceleration":
            self._speed, self._now = speed, now

    def value(self, motor: int, now: float) -> float:
        """Return the command for a motor value, at the time `now` in s."""
        wanted = self._size * motor / LARGEST_MOTOR
        self._pass_time(now)
        if self._sends == "value":
            return self._sign * wanted
        largest = self._size + self._damping * self._fastest
        # a line has few decimals: the damping of a cart that creeps would be sent as 0, and it would creep on
        creeps = self._sends == "acceleration" and motor == 0 and abs(self._speed) < self._creep
        damping = max(self._damping, 1 / SETTLING) if creeps else self._damping
        self._acceleration = max(-largest, min(largest, wanted - damping * self._speed))
        if abs(self._speed) >= self._fastest and self._speed * self._acceleration > 0:
            self._acceleration = 0.0
        return self._sign * (self._speed if self._sends == "speed" else self._acceleration)

    def slowing(self, now: float, stands: bool | None) -> float | None:
        """Return the command that slows the cart to rest; None if it stands or the board's stop does it.

        `stands` is what the newest counts say, None if nothing is measured.
        """
        if self._sends == "speed":
            slowed = max(0.0, abs(self._speed) - self._size * min(now - self._now, LONGEST_STEP))
            self._speed, self._acceleration, self._now = math.copysign(slowed, self._speed), 0.0, now
            return self._sign * self._speed if slowed else None
        self._pass_time(now)
        stands = stands is not False and abs(self._speed) < (STANDS if stands is None else self._creep)
        if self._sends == "value" or stands:
            self._speed = self._acceleration = 0.0
            return None
        self._acceleration = -math.copysign(min(self._size, abs(self._speed) / SETTLING), self._speed)
        return self._sign * self._acceleration

    def _pass_time(self, now: float) -> None:
        speed = self._speed + self._acceleration * min(now - self._now, LONGEST_STEP)
        if self._sends == "speed":
            speed = max(-self._fastest, min(self._fastest, speed))
        self._speed, self._now = speed, now


class Bridge:
    """One board between its driver and the port of a `Channel`. The end of a `with` stops the board."""

    def __init__(
        self,
        settings: BoardSettings,
        hardware: Hardware,
        driver: Driver,
        control_period: float | None,
        lever: int,
    ) -> None:
        self._lever = lever
        self._settings, self._hardware, self._driver = settings, hardware, driver
        self._lock, self._ending = Lock(), Event()
        self._failure: CartPoleError | None = None
        self._booted = now()
        self._control_period = control_period
        self._channel: Channel | None = None
        self._last: Measurement | None = None
        self._arrived_us = 0  # when the last measurement came
        self._passed_us = 0  # when the driver's `read` last returned
        self._suspects: list[Measurement] = []  # implausible ones in a row
        self._bad = self._excess = 0  # damaged measurements, and how many more than whole ones lately
        self._pole = 0  # unwrapped
        turn = hardware.pole_counts_per_turn
        if settings.pole_range is not None and settings.pole_range[1] - settings.pole_range[0] >= turn:
            raise ConfigError(f"plant.pole_range covers the whole turn of {turn} counts: leave it out")
        self._potentiometer = Potentiometer(*(settings.pole_range or (-MOST, MOST)), turn)
        self._recent: deque[tuple[int, int]] = deque(maxlen=SAMPLES)  # us and cart count of the newest
        self._changed_us = 0  # when the cart's count last changed
        self._place = self._place_us = 0  # the count about which the cart stands, and since when
        self._stands_within = max(1, hardware.encoders.cart_counts(STANDS_WITHIN))
        self._measured = 0  # of the control period
        self._stops_left = STOPS  # whatever the board did before
        self._homing_stops = 0  # that a homing of the board needs yet, if it is broken off
        self._has_ended = False

    def listen(self) -> None:
        """Open and stop the board; learn how often it measures. Raises LinkError, PortError, ConfigError."""
        if self._settings.homing == "board" and type(self._driver).home is Driver.home:
            raise ConfigError("plant.homing=board: the driver has no method home; give hand or stops")
        if self._settings.homing == "stops" and self._hardware.switches:
            raise ConfigError(
                "plant.homing=stops: cart= has end switches, which only its board reads; give hand or board"
            )
        home, half_span = self._settings.home_position, self._hardware.half_span
        if abs(home) >= half_span:
            raise ConfigError(
                f"plant.home_position={home:g} is beyond the track, which ends {half_span:g} m from the "
                "middle: give metres from the middle, and the track in cart="
            )
        self._driver.open()
        for _ in range(STOPS):
            self._driver.stop()
        board_us = self._learn_period()
        if not FASTEST_BOARD_US <= board_us <= LONGEST_US:
            raise LinkError(
                f"{self._settings.port} measures every {board_us / 1e3:.3g} ms by its time; a bridge needs "
                f"{FASTEST_BOARD_US / 1e3:g} to {LONGEST_US / 1e3:.0f} ms: correct time_unit, or how "
                "often it sends"
            )
        self._begin(board_us)
        if self._control_period is not None:
            self._stand_in.check_period(round(1e6 * self._control_period))

    def _learn_period(self) -> int:
        """Return the mean time between two measurements, us. Raises LinkError."""
        stamps: list[int] = []
        began = time.monotonic()
        deadline = began + self._settings.connect_timeout + LISTENED_TO_ARRIVALS
        arrivals = False
        while len(stamps) < LISTENED or (arrivals and time.monotonic() < began + LISTENED_TO_ARRIVALS):
            measurement = self._read(max(0.0, deadline - time.monotonic()))
            if measurement is None and time.monotonic() < deadline:
                continue
            if measurement is None:
                came = f"only {len(stamps)} measurements came" if stamps else "no measurement comes"
                raise LinkError(f"{came} from {self._settings.port}: {self._what_came()}")
            arrivals = measurement.us is None
            stamps.append(self._now_us() if measurement.us is None else measurement.us)
        gaps = [after - before for before, after in pairwise(stamps)]
        middle = median(gaps)
        if middle <= 0:
            raise LinkError(
                f"the time of {self._settings.port} does not advance: {stamps[-2]} us, then {stamps[-1]} us"
            )
        if arrivals and middle < mean(gaps) / 2:
            raise LinkError(
                f"the measurements of {self._settings.port} come in bursts, so nobody knows when each was "
                "made: let the board send its time, or set the latency of the USB adapter to 1 ms"
            )
        whole = [gap for gap in gaps if 0 <= gap <= FEW_LOST * middle]
        period = mean(whole)  # not the median: stamps may be in whole milliseconds
        return round(sum(whole) / sum(max(1, round(gap / period)) for gap in whole))

    def _read(self, timeout: float) -> Measurement | None:
        """Return the driver's next measurement. Raises LinkError if it gives anything else."""
        given = self._driver.read(timeout)
        if given is None or isinstance(given, Measurement):
            return given
        raise LinkError(
            f"plant.driver={self._settings.driver}: read returned {given!r}; return a Measurement, or None"
        )

    def run(self, channel: Channel) -> None:
        """Pass measurements and commands on; return only by an exception. Raises LinkError if lost."""
        self._channel = channel
        self._arrived_us = self._passed_us = self._now_us()
        try:
            self._bad = self._driver.bad
            Thread(target=self._hear, daemon=True).start()
            while True:
                measurement = self._read(LATE_PERIODS * self._board_us * 1e-6)
                with self._one_at_a_time():
                    if self._failure is not None:
                        raise self._failure
                    self._pass(measurement)
        except CartPoleError:
            raise
        except Exception as error:
            raise driver_error(self._settings, error) from error

    @contextmanager
    def _one_at_a_time(self) -> Iterator[None]:
        """Keep the other thread from the driver. Raises LinkError if it hangs in it."""
        longest = max(LONGEST_CALL, self._settings.write_timeout)
        if not self._lock.acquire(timeout=longest):
            raise LinkError(
                f"plant.driver={self._settings.driver}: send, stop or home did not return for {longest:g} s"
            )
        try:
            yield
        finally:
            self._lock.release()

    def _hear(self) -> None:
        """Take the frames of the host as they come; stop the board while the other thread hangs."""
        assert self._channel is not None
        try:
            while self._failure is None:
                frames = self._channel.receive(self._stand_in.period_us * 1e-6)
                with self._one_at_a_time():
                    for frame in frames:
                        self._obey(frame)
                    if self._hangs() and self._failure is None:
                        self._wait(self._now_us())
        except Exception as error:
            self._failure = driver_error(self._settings, error)
            while not self._ending.wait(self._stand_in.period_us * 1e-6):
                if self._hangs():  # otherwise that thread raises the failure, and stops the board
                    with suppress(Exception):
                        self._stop_again()

    def _stop_again(self) -> None:
        """Stop the board, whatever the last stop did; slow a stepper down first if `send` is free."""
        if not self._lock.acquire(blocking=False):  # the other thread hangs in the driver
            self._driver.stop()
            return
        try:
            if not self._ending.is_set():
                self._stops_left = STOPS
                self._wait(self._now_us())
        finally:
            self._lock.release()

    def _hangs(self) -> bool:
        """Return True while the driver's `read`, or a command of the reading thread, does not return."""
        return self._now_us() - self._passed_us > HUNG_PERIODS * self._stand_in.period_us

    def _obey(self, frame: bytes | None) -> None:
        if frame is None or self._failure is not None:
            return
        before, now_us = self._stand_in.motor, self._now_us()
        answer = self._stand_in.receive(frame, now_us)
        self._stand_in.drive(now_us)
        if isinstance(self._stand_in.carried_out, Home | Stop) or self._stand_in.motor != before:
            self._stops_left = STOPS  # the board may have begun to home since the last ones
            self._command()
        self._send(answer)  # after the command: a STOP that the board did not get is not acknowledged

    def _pass(self, measurement: Measurement | None) -> None:
        """Pass a measurement on, or what its absence means."""
        now_us = self._passed_us = self._now_us()
        taken = measurement is not None and self._take(measurement, now_us)
        silent = (now_us - self._arrived_us) * 1e-6
        new_bad, self._bad = self._driver.bad - self._bad, self._driver.bad
        self._excess = max(0, self._excess + new_bad - taken)
        if self._excess > MOST_BAD:
            raise LinkError(f"most of what comes from {self._settings.port} is damaged: {self._what_came()}")
        if silent > self._settings.timeout / 2:  # before the host takes the bridge for lost
            raise LinkError(
                f"no measurement came from {self._settings.port} for {silent:.1f} s: {self._what_came()}"
            )
        if not taken:
            self._wait(now_us)
            return
        if self._measured_us > now_us + MOST_AHEAD_US:
            raise LinkError(
                f"{self._settings.port} measures far more often than when it was opened; connect it again"
            )
        if self._measured:  # within a control period
            self._stand_in.look(self._measured_us, *self._counts)
        else:
            frames = self._stand_in.measure(now_us, self._measured_us, self._stamp_us, self._counts)
            self._send(frames)
        self._measured = (self._measured + 1) % self._stand_in.every
        self._command()

    def _wait(self, now_us: int) -> None:
        """Apply the rules of the clock: no measurement comes."""
        silent_us = now_us - self._arrived_us
        self._stand_in.wait(now_us)
        if silent_us > LATE_PERIODS * self._board_us:
            self._command(silent=silent_us > SILENT_PERIODS * self._stand_in.period_us)

    def _take(self, given: Measurement, now_us: int) -> bool:
        """Note a measurement; return False for one that is implausible: damaged on the way, or repeated."""
        try:
            cart, pole = index(given.cart), index(given.pole)
            us = now_us if given.us is None else self._unwrapped(index(given.us))
        except TypeError:
            return self._refuse(f"{given} is not in whole counts and us")
        if max(abs(cart), abs(pole)) > MOST_COUNTS:
            return self._refuse(f"{given} has a count beyond 32 bits: give signed ones")
        settings, last = self._settings, self._last
        carried = self._potentiometer.count(pole, us)
        if carried is not None:
            turned = -carried if settings.pole_reversed else carried
        elif last is None:
            return self._refuse(f"the pole is outside plant.pole_range, at {pole}")
        else:
            turned = last.pole  # the cart's count still rules
        new = Measurement(-cart if settings.cart_reversed else cart, turned, us)
        if last is None:
            self._pole = new.pole
            return self._accept(new, pole, now_us)
        if new.us == last.us:
            return self._refuse(f"its time stands still at {new.us} us")
        if not self._clock.is_early(us, now_us) and self._fits(
            last, new, now_us - self._arrived_us, len(self._suspects)
        ):
            if carried is None:
                self._stand_in.lose_pole()
            self._pole += self._turned(last, new)
            return self._accept(new, pole, now_us)
        if self._suspects and not self._fits(self._suspects[-1], new, now_us - self._arrived_us):
            self._suspects.clear()
        self._suspects.append(new)
        if len(self._suspects) < CONFIRMED:
            return self._refuse(f"its numbers jump: {last}, then {new}")
        assert last.us is not None
        if self._stand_in.board_homes and 0 < us - last.us <= longest_gap(now_us - self._arrived_us):
            self._stand_in.recount()
            self._recent.clear()
        else:
            self._begin(self._board_us)
        self._pole = new.pole
        return self._accept(new, pole, now_us)

    def _unwrapped(self, us: int) -> int:
        last = us if self._last is None or self._last.us is None else self._last.us
        return unwrapped(us, last)

    def _fits(self, last: Measurement, new: Measurement, arrived: int, refused: int = 0) -> bool:
        """Return True if a cart can move from one measurement to the other; `arrived` us lie between at most.

        The time of `refused` measurements between them does not count: a jump stays one.
        """
        assert last.us is not None
        assert new.us is not None
        passed = new.us - last.us
        if passed <= 0 or passed > longest_gap(arrived):
            return False
        passed = max(passed - refused * self._board_us, self._board_us)
        way = (abs(new.cart - last.cart) - 1) * self._hardware.cart_nanometres_per_count
        unsure = self._potentiometer.width + 1  # an estimate may be off by the whole dead zone
        turn = (abs(self._turned(last, new)) - unsure) / self._hardware.pole_counts_per_turn
        return way * 1e6 <= FASTEST_CART * passed and turn * 1e6 <= FASTEST_POLE * passed

    def _turned(self, last: Measurement, new: Measurement) -> int:
        """Return by how many counts the pole has turned, the shorter way round."""
        turn = self._hardware.pole_counts_per_turn
        return (new.pole - last.pole + turn // 2) % turn - turn // 2

    def _accept(self, new: Measurement, reading: int, now_us: int) -> bool:
        assert new.us is not None
        self._suspects.clear()
        self._last, self._arrived_us = new, now_us
        self._counts, self._stamp_us = (new.cart, self._pole), new.us
        self._potentiometer.accept(reading, new.us)
        self._measured_us = self._clock.measured_us(new.us, now_us)
        if not self._recent or abs(new.cart - self._place) > self._stands_within:
            self._place, self._place_us = new.cart, new.us
        before = self._recent[-1][1] if self._recent else None
        self._recent.append((new.us, new.cart))
        if new.cart != before:
            if before is not None:
                self._commands.measured(self._cart_speed(new, before), now_us * 1e-6)
            self._changed_us = new.us
        return True

    def _refuse(self, why: str) -> bool:
        self._driver.bad += 1
        self._driver.why_bad = why
        return False

    def _begin(self, board_us: int) -> None:
        """Begin, or begin anew, not homed: the board has restarted, or counts something else now."""
        self._board_us = board_us
        self._stand_in = StandIn(self._settings, self._hardware, board_us, self._driver, self._lever)
        self._clock, self._measured = BoardClock(board_us), 0
        self._recent.clear()
        self._commands = self._new_commands()
        self._potentiometer.forget()

    def _new_commands(self) -> MotorCommands:
        """Return the commands of a cart at rest, whose speed is known to a count a measurement."""
        creep = self._hardware.encoders.metres / self._board_us * 1e6
        return MotorCommands(self._settings, min(creep, LARGEST_CREEP))

    def _command(self, silent: bool = False) -> None:
        """Send what drives the board, or what stops it, also while no measurement comes (`silent`)."""
        stand_in, now_us = self._stand_in, self._now_us()
        if stand_in.board_homes:
            self._commands = self._new_commands()  # what was sent before counts no more
            self._stops_left = STOPS  # for a homing that is ended
            self._homing_stops = STOPS - 1  # the last one follows when the cart stands
            return
        if stand_in.homing:
            self._homing_stops = 0  # the board was done
        elif self._homing_stops:
            self._stop_board_homing()
            return
        if stand_in.is_active:
            self._stops_left = STOPS
            if not silent and not stand_in.is_idle(now_us):
                if stand_in.homing and not stand_in.motor:  # 0 would let a stepper keep its speed
                    value = self._commands.slowing(now_us * 1e-6, self._stands(silent)) or 0.0
                else:
                    value = self._commands.value(stand_in.motor, now_us * 1e-6)
                self._send_value(value)
                return
        command = self._commands.slowing(now_us * 1e-6, self._stands(silent)) if self._stops_left else None
        if command is not None:
            self._send_value(command)
        elif self._stops_left:
            self._stops_left -= 1
            self._driver.stop()

    def _stop_board_homing(self) -> None:
        """Stop a board that may still home by itself: it takes no commands until then."""
        self._homing_stops -= 1
        self._stops_left -= 1
        self._driver.stop()
        self._recent.clear()
        self._commands = self._new_commands()

    def _send_value(self, value: float) -> None:
        """Command the board. Raises LinkError for a value that is not finite; the board is stopped then."""
        if not math.isfinite(value):
            raise LinkError(f"the command {value} is not finite")
        self._driver.send(value)

    def _stands(self, silent: bool) -> bool | None:
        if silent or self._last is None or self._last.us is None:
            return None
        return self._last.us - self._place_us >= STANDS_US

    def _cart_speed(self, new: Measurement, before: int) -> float:
        """Return the speed, m/s, of a cart whose count was `before`; a slow one changes it seldom."""
        assert new.us is not None
        since_us, since = self._recent[0]
        if abs(new.cart - before) == 1 and self._changed_us < since_us:
            since_us, since = self._changed_us, before
        return (new.cart - since) * self._hardware.encoders.metres / max(1, new.us - since_us) * 1e6

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, why: BaseException | None, traceback: object) -> None:
        """Stop the board, whatever has happened; signals wait until then. Raises LinkError if it cannot.

        A signal in its first instructions may end it at once: whoever runs the bridge ends it twice.
        """
        if self._has_ended:
            return
        for number in (signal.SIGINT, *ending_signals()):
            signal.signal(number, signal.SIG_IGN)
        unstopped: Exception | None = None
        self._ending.set()
        free = self._lock.acquire(timeout=LONGEST_CALL)  # and not given back: nothing else may be sent
        self._failure = self._failure or LinkError("the bridge has ended")
        with suppress(Exception):
            if free:
                while self._homing_stops:
                    self._stop_board_homing()
                self._slow_down()
        for _ in range(STOPS):
            try:
                self._driver.stop()
                unstopped = None
            except Exception as error:
                unstopped = error
        with suppress(Exception):
            self._driver.close()
        self._has_ended = True
        if unstopped is not None and self._channel is not None:  # it was driven
            said = driver_error(self._settings, why if isinstance(why, Exception) else unstopped)
            raise LinkError(
                f"{said}; the board was not stopped: its motor may still be on, switch it off"
            ) from unstopped

    def _slow_down(self) -> None:
        deadline, silent, hangs = time.monotonic() + STOPPING, False, self._hangs()
        while time.monotonic() < deadline:
            command = self._commands.slowing(self._now_us() * 1e-6, self._stands(silent))
            if command is None:
                return
            self._send_value(command)
            measurement, waited = None, False
            with suppress(Exception):  # the speed then follows from what was sent
                if not hangs:
                    measurement, waited = self._read(self._board_us * 1e-6), True
            if not waited:
                time.sleep(self._board_us * 1e-6)
            silent = measurement is None
            if measurement is not None:
                self._take(measurement, self._now_us())

    def _send(self, frames: list[bytes]) -> None:
        assert self._channel is not None
        for frame in frames:
            self._channel.send(frame)

    def _what_came(self) -> str:
        driver = self._driver
        if driver.bad:
            compare = f"compare the settings of plant={self._settings.kind} with what the board sends"
            return f"{driver.why_bad}; {compare}"
        return "nothing was received; check the cable, the power and plant.baud"

    def _now_us(self) -> int:
        return int((now() - self._booted) * 1e6)


def longest_gap(arrived: int) -> int:
    """Return the longest time, us by the board, between two measurements that arrived so many us apart."""
    return 2 * arrived + 1_000_000


def driver_error(settings: BoardSettings, error: Exception) -> CartPoleError:
    """Return a driver's error as one line that says what is wrong; the error itself if it is one."""
    if isinstance(error, CartPoleError):
        return error
    return LinkError(f"plant.driver={settings.driver} failed: {type(error).__name__}: {reason_of(error)}")
