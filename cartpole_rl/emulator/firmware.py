"""The firmware of the emulated cart: protocol version 2 as a state machine without I/O or real clocks.

The caller passes frames with their time of arrival and advances the time: `drive` brings motor values that
are due into force, `look` is called once a millisecond with the cart's count, `tick` at the end of each
period (read the encoders, apply the rules, report). The cart is idle, homing or armed; a latched fault
disarms it. ``docs/protocol.md`` has the rules. All times are whole microseconds
since boot.
"""

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import replace

from cartpole_rl.emulator.guards import (
    FASTEST_CART,
    FASTEST_POLE,
    LEVER,
    LONGEST_US,
    SAMPLES,
    SHORTEST_US,
    FrozenCartWatch,
    FrozenPoleWatch,
    JumpWatch,
    StallWatch,
    TrackLimits,
    micrometres,
    nearest_count,
)
from cartpole_rl.emulator.homing import SHORTEST_LOOK, Homing, HomingError, Reading, Zeros
from cartpole_rl.emulator.settings import LARGEST_MOTOR
from cartpole_rl.errors import FrameError
from cartpole_rl.rig.hardware import Hardware, nominal_hardware
from cartpole_rl.wire.frames import VERSION, Envelope, encode_frame, open_envelope
from cartpole_rl.wire.messages import (
    FROM_CART,
    MESSAGES,
    Ack,
    ClearFault,
    Fault,
    FaultReport,
    Flags,
    Hello,
    Home,
    Info,
    Message,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
)

FIRMWARE = (2, 0, 0)  # from 2.0.0 on, protocol version 2
# the text of an ESP32, and one 0x00 that separates it from the first frame
BANNER = (
    b"ets Jul 29 2019 12:21:46\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\ncart %d.%d.%d\r\n\x00" % FIRMWARE
)
PERIOD_US = 20_000
WATCHDOG_PERIODS = 3  # after a state was measured, no motor value that answers it is in force any more
KEPT_TICKS = WATCHDOG_PERIODS + 1
LEASE_US = 500_000  # without an accepted frame, after which homing ends
NO_AGE = 65535
U32 = 0xFFFFFFFF
UNDERSTOOD = {kind for kind in MESSAGES if not kind & FROM_CART} - {StartPolicy.TYPE}  # it has no policy
MOST_PENDING = 1024  # the line's memory is bounded, as a board's is


class MotorLine:
    """The requested motor value and the pending ones, each due one latency after its arrival.

    No command overtakes another.
    """

    def __init__(self) -> None:
        self.requested = 0
        self._pending: deque[tuple[int, int]] = deque()  # (due, value)

    def command(self, due_us: int, value: int) -> None:
        """Bring a value into force at `due_us`, or together with an earlier command that is due later.

        If no more commands can wait, the value replaces the newest one.
        """
        newest = self._pending[-1][0] if self._pending else 0
        if len(self._pending) == MOST_PENDING:
            self._pending.pop()
        self._pending.append((max(due_us, newest), value))

    def stop(self, now_us: int) -> None:
        """Bring 0 into force at `now_us` and discard values that are due later."""
        while self._pending and self._pending[-1][0] > now_us:
            self._pending.pop()
        self.command(now_us, 0)

    def hold(self, value: int) -> None:
        """Put a value into force at once and discard all pending ones."""
        self._pending.clear()
        self.requested = value

    def drive(self, now_us: int) -> None:
        """Bring the values that are due into force."""
        while self._pending and self._pending[0][0] <= now_us:
            _, self.requested = self._pending.popleft()

    def next_due(self, before_us: int) -> int:
        """Return when the next value is due, `before_us` if none is due before that."""
        return min(before_us, self._pending[0][0]) if self._pending else before_us


class Firmware:
    """The firmware of one cart, just booted: idle, not homed, motor 0."""

    def __init__(
        self,
        delay_us: Callable[[], int],
        zero_error: int = 0,
        lever_um: int = LEVER,
        hardware: Hardware | None = None,
        samples: int = SAMPLES,
        look_us: int = 0,
    ) -> None:
        """`delay_us` returns a command's latency; homing sets the pole's zero `zero_error` counts too low.

        `lever_um`, `samples` and `look_us` are those of `TrackLimits`; `hardware` is ip02's if it is None.
        """
        self._hardware = hardware = hardware or nominal_hardware()
        self.period_us = PERIOD_US
        self.armed = False
        self.homed = False
        self.fault = Fault.NONE
        self._reported = Fault.NONE  # by the newest FAULT frame
        self.carried_out: Message | None = None  # the newest message; None if it was refused or damaged
        self._delay_us = delay_us
        self._zero_error = zero_error
        self._line = MotorLine()
        self._limits = TrackLimits(hardware, lever_um, samples, look_us)
        self._limited = False  # the limits have changed the motor value since the newest tick
        self._homing: Generator[int, Reading, Zeros] | None = None
        self._waited_us = 0  # since homing read the counts
        half_span = nearest_count(micrometres(hardware.track_span) // 2, hardware)
        self._zeros = Zeros(-half_span, half_span, hanging=0)
        self._pole_zero = 0  # raw count that is reported as 0
        self._command_us: int | None = None  # when the newest SET_MOTOR arrived
        self._expires_us = 0  # the watchdog then sets the motor to 0
        self._heard_us = 0  # when the newest accepted frame arrived
        self._last_sequence = 0  # of the host
        self._sequence = 0  # of the next frame sent
        self._ticks = 0
        self._measured_us = [0] * KEPT_TICKS  # times of the newest ticks, at their number modulo 4
        self._cart = self._pole = 0  # raw counts that were read last
        self.switches = 0  # end switches that are pressed, 1 left, 2 right; set it before each `look`
        self._seen = 0  # switches at the newest look
        self._pressed = 0  # switches at the newest two looks: a single look may be noise
        self._pressed_at = 0  # raw count of the cart at the look that saw a switch newly pressed
        self._reset_watches()

    @property
    def homing(self) -> bool:
        """True while the cart is homing."""
        return self._homing is not None

    @property
    def motor(self) -> int:
        """The motor value in force."""
        if self._limits.brake:
            return self._limits.brake * LARGEST_MOTOR
        return 0 if self._line.requested * self._limits.blocked > 0 else self._line.requested

    def receive(self, stuffed: bytes, now_us: int) -> list[bytes]:
        """Handle one frame without its final 0x00; return the answer, at most one frame."""
        self.carried_out = None
        try:
            envelope = open_envelope(stuffed)
        except FrameError:
            return []  # nothing in a damaged frame can be trusted
        answer = self._obey(envelope, now_us)
        if isinstance(answer, Reason):
            return [self._frame(Nack(envelope.sequence, envelope.kind, answer))]
        self._last_sequence, self._heard_us = envelope.sequence, now_us
        return [self._frame(answer)] if answer else []

    def drive(self, now_us: int) -> None:
        """Bring the motor values that are due into force."""
        self._line.drive(now_us)

    def next_due(self, before_us: int) -> int:
        """Return when the next motor value is due, `before_us` if none is due before that."""
        return self._line.next_due(before_us)

    def look(self, now_us: int, cart: int, pole: int) -> None:
        """Apply the rules that cannot wait for the end of a period, to the clock and the raw counts."""
        self._expire(now_us)
        self._see_switches(cart)
        self._limits.sample(now_us, cart, pole)
        self._limit(now_us, cart, pole)

    def _see_switches(self, cart: int) -> None:
        """Stop a homing cart at a newly pressed switch; fault an armed one at any that is pressed."""
        switches = self._hardware.switches & self.switches
        pressed, self._seen = switches & self._seen, switches
        if pressed & ~self._pressed:
            self._pressed_at = cart
            if self.homing:
                self._line.hold(0)
        self._pressed = pressed
        if self.armed and pressed:
            self._latch(Fault.HARD_LIMIT | Fault(pressed * Fault.LEFT_SWITCH))

    def tick(self, now_us: int, cart: int, pole: int) -> list[bytes]:
        """End a period with two raw counts: apply the rules and return the frames to send, STATE last."""
        us = max(1, now_us - self._ticked_us)
        reading = Reading(cart, pole, us, self._pressed, self._pressed_at)
        self._ticks += 1
        self._measured_us[self._ticks % KEPT_TICKS] = now_us
        self._limits.sample(now_us, cart, pole)
        expired = self._expire(now_us)
        if self.armed or self.homing:
            self._check_faults(reading)
        if self._homing:
            self._step_homing(self._homing, reading)
        self._limit(now_us, cart, pole)
        flags = self._flags() | (Flags.WATCHDOG if expired and self.armed else Flags(0))
        if self._limited:
            flags |= Flags.SOFT_LIMIT
        self._limited = self.motor != self._line.requested
        report = [FaultReport(self.fault, self._ticks & U32)] if self.fault & ~self._reported else []
        self._reported = self.fault
        return [self._frame(message, flags) for message in (*report, self._state(cart, pole))]

    def _expire(self, now_us: int) -> bool:
        """End a homing without a host; return whether the watchdog holds the motor at 0."""
        if self.homing and now_us > self._heard_us + LEASE_US:
            self._homing = None
            self._line.hold(0)
        expired = self.armed and now_us >= self._expires_us
        if expired:
            self._line.hold(0)
        return expired

    def _limit(self, now_us: int, cart: int, pole: int) -> None:
        """Let the limits of the track decide, which need the zeros of a homing."""
        self._cart, self._pole = cart, pole
        if self.homing:
            self._limits.release()
        else:
            if self.armed and self._limits.cart_jumped():
                self._latch(Fault.CART_ENCODER)
            if self.armed and self._limits.pole_jumped():
                self._latch(Fault.POLE_ENCODER)
            if self.armed and self._limits.lost(now_us, self.motor):
                self._latch(Fault.CART_ENCODER)
                self._brake_blindly(now_us)
            self._apply_limits(now_us)
        self._limited |= self.motor != self._line.requested

    def _apply_limits(self, now_us: int) -> None:
        """Let the limits decide about the requested motor value, by the counts that were read last."""
        outward, angle = self._cart - self._zeros.middle, self._pole - self._pole_zero
        half_span, motor = self._zeros.half_span, self._line.requested
        self._limits.apply(now_us, outward, angle, half_span, self.armed, self._pressed, motor)

    def _obey(self, envelope: Envelope, now_us: int) -> Message | Reason | None:
        """Carry out a frame and return the answer; None for SET_MOTOR, which the next STATE acknowledges."""
        if envelope.version != VERSION:
            return Reason.BAD_VERSION
        if envelope.kind not in UNDERSTOOD:
            return Reason.UNKNOWN_TYPE
        try:
            message = MESSAGES[envelope.kind].unpack(envelope.payload)
        except FrameError:
            return Reason.BAD_LENGTH
        reason = self._objection(message, now_us)
        if reason is not None:
            return reason
        self._carry_out(message, now_us)
        self.carried_out = message
        if isinstance(message, SetMotor):
            return None
        if isinstance(message, Hello | SetPeriod):
            return self._info()
        return Ack(envelope.sequence, envelope.kind)

    def _objection(self, message: Message, now_us: int) -> Reason | None:
        """Return the reason for which a message is refused now, or None."""
        match message:
            case SetMotor(motor) if abs(motor) > LARGEST_MOTOR:
                return Reason.OUT_OF_RANGE
            case SetPeriod(period_us) if not SHORTEST_US <= period_us <= LONGEST_US:
                return Reason.OUT_OF_RANGE
            case SetMotor() | Start() | Home() | SetPeriod() if self.homing:
                return Reason.BUSY
            case Home() | SetPeriod() if self.armed:
                return Reason.BUSY
            case Home() if self._limits.brake:  # homing would end the brake
                return Reason.BUSY
            case SetMotor() | Start() | Home() if self.fault:
                return Reason.FAULT_LATCHED
            case Start() if not self.homed:
                return Reason.NOT_HOMED
            case SetMotor() if not self.armed:
                return Reason.NOT_ARMED
            case SetMotor(motor, tick) if motor and now_us >= self._expiry(tick):
                return Reason.STALE
        return None

    def _expiry(self, tick: int) -> int:
        """Return until when an answer to the STATE of `tick` may be in force; 0 for an old or unknown one."""
        if (self._ticks - tick) & U32 >= KEPT_TICKS:
            return 0
        return self._measured_us[tick % KEPT_TICKS] + WATCHDOG_PERIODS * self.period_us

    @property
    def _ticked_us(self) -> int:
        return self._measured_us[self._ticks % KEPT_TICKS]

    def _carry_out(self, message: Message, now_us: int) -> None:
        match message:
            case SetMotor(motor, tick):
                self._command_us, self._expires_us = now_us, self._expiry(tick)
                self._line.command(now_us + self._delay_us(), motor)
            case Start() if not self.armed:
                self.armed, self._expires_us = True, self._expiry(self._ticks)
                self._reset_watches()
                self._limit(now_us, self._cart, self._pole)
            case Stop():
                self.armed, self._homing = False, None
                self._line.stop(now_us)
            case Home():
                self.homed, self._homing, self._waited_us = False, self._home(), 0
                next(self._homing)
                self._line.hold(0)
                self._limits.release()
                self._reset_watches()
            case ClearFault():
                self.fault = self._reported = Fault.NONE
            case SetPeriod(period_us):
                self.period_us = period_us

    def _brake_blindly(self, now_us: int) -> None:
        self._limits.brake_blindly(now_us)

    def _home(self) -> Generator[int, Reading, Zeros]:
        """Return the procedure that finds the zeros."""
        return Homing(self._hardware).home()

    def _step_homing(self, homing: Generator[int, Reading, Zeros], reading: Reading) -> None:
        """Let homing choose the motor value, or end it with its zeros or a fault."""
        self._waited_us += reading.us
        if self._waited_us < SHORTEST_LOOK:
            return
        reading, self._waited_us = replace(reading, us=self._waited_us), 0
        try:
            self._line.hold(homing.send(reading))
        except StopIteration as end:
            self._zeros = end.value
            self._pole_zero = end.value.hanging - self._hardware.pole_counts_per_turn // 2 - self._zero_error
            self.homed, self._homing = True, None
            self._line.hold(0)
        except HomingError as error:
            self._latch(Fault.HOMING | Fault(error.switches * Fault.LEFT_SWITCH))

    def _check_faults(self, reading: Reading) -> None:
        """Latch new faults. Homing may touch the stops and detects a stall itself."""
        motor = self.motor
        jumped = self._cart_jumps.jumped(reading.cart, reading.us)
        if self._cart_freezes.frozen(reading.cart, motor, reading.us) or jumped:
            self._latch(Fault.CART_ENCODER)
        jumped = self._pole_jumps.jumped(reading.pole, reading.us)
        if self._pole_freezes.frozen(reading.pole, reading.cart, reading.us) or jumped:
            self._latch(Fault.POLE_ENCODER)
        beyond = abs(reading.cart - self._zeros.middle) >= self._zeros.half_span - self._limits.hard
        if self.armed and beyond:
            self._latch(Fault.HARD_LIMIT)
        if self.armed and self._stalls.stalled(reading.cart, motor, reading.us):
            self._latch(Fault.STALL)

    def _latch(self, fault: Fault) -> None:
        """Disarm, set motor 0 and latch the fault. That of an encoder or a switch makes the zeros invalid."""
        self.fault |= fault
        self.armed, self._homing = False, None
        self._line.hold(0)
        if fault & (Fault.CART_ENCODER | Fault.POLE_ENCODER | Fault.LEFT_SWITCH | Fault.RIGHT_SWITCH):
            self.homed = False
        if fault == Fault.CART_ENCODER:
            self._limits.release()  # nobody knows where the cart is

    def _reset_watches(self) -> None:
        """Start with new guards: a hand may have moved cart and pole while the motor was off."""
        hardware = self._hardware
        self._cart_jumps = JumpWatch(FASTEST_CART // hardware.cart_nanometres_per_count)
        self._pole_jumps = JumpWatch(FASTEST_POLE * hardware.pole_counts_per_turn)
        self._cart_freezes, self._pole_freezes = FrozenCartWatch(hardware), FrozenPoleWatch(hardware)
        self._stalls = StallWatch(hardware)
        self._limits.forget()

    def _info(self) -> Info:
        half_span, limits = self._zeros.half_span, self._limits
        return Info(
            *FIRMWARE,
            self._hardware.pole_counts_per_turn,
            self._hardware.cart_nanometres_per_count,
            LARGEST_MOTOR,
            half_span - limits.soft,
            half_span - limits.hard,
            self.period_us,
            0,  # it has no policy
        )

    def _state(self, cart: int, pole: int) -> State:
        now_us = self._ticked_us
        age = NO_AGE if self._command_us is None else (now_us - self._command_us) // 1000
        return State(
            self._ticks & U32,
            now_us & U32,
            cart - self._zeros.middle,
            pole - self._pole_zero,
            self.motor,
            self._last_sequence,
            self.fault,
            max(0, min(age, NO_AGE)),  # a board that was read late may have measured before the command
        )

    def _flags(self) -> Flags:
        return (
            (Flags.ARMED if self.armed else Flags(0))
            | (Flags.HOMED if self.homed else Flags(0))
            | (Flags.HOMING if self.homing else Flags(0))
            | (Flags.FAULTED if self.fault else Flags(0))
            | (Flags.SOFT_LIMIT if self.motor != self._line.requested else Flags(0))
            | Flags(self._hardware.switches * Flags.LEFT_SWITCH)
        )

    def _frame(self, message: Message, flags: Flags | None = None) -> bytes:
        frame = encode_frame(message, self._sequence, self._flags() if flags is None else flags)
        self._sequence = (self._sequence + 1) & 0xFF
        return frame
