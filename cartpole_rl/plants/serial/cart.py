"""The host's side of a cart on a serial port: the original four calls, and what a careful lab adds.

Which state counts. The cart dictates the pace: it sends a STATE each period, the host answers with one
command. `get_state` returns the newest state, and only one that was measured after the cart had taken the
last frame (STATE tells its sequence), so that a loop never acts on the past and never looks for a command's
effect in a state from before it. A command that was lost on the way is never acknowledged: one and a half
periods after it the newest state is taken as it is.

A STATE that comes again, or after a newer one, is never taken for the newest. It is told by its tick, which
is at or a little below the newest one's; a tick that is far below is a cart that has restarted.

Late ticks, while states are answered with motor values: each state that is passed over, and each one whose
command went out later than a period after it came. The second is counted only where the cart's tick went on
meanwhile: a lockstep emulator waits for the host, and nothing is late there.

When nothing comes. After `nudge_after` seconds of silence the host says HELLO. That is harmless to a cart
with a clock of its own, and lets a lockstep emulator, which moves once per frame, go on after a lost frame.

The protocol is written out in `docs/protocol.md`.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Annotated, Self, TypeVar

from pydantic import Field

from cartpole_rl.errors import LinkError, PlantError
from cartpole_rl.plants.serial.errors import RefusedError, fault_error, refusal
from cartpole_rl.plants.serial.information import LONGEST_PERIOD_US, check_limits, check_scales
from cartpole_rl.plants.serial.link import SerialLink
from cartpole_rl.plants.serial.port import open_port, resolved_port
from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.settings import Count, Positive, Settings
from cartpole_rl.wire import (
    Ack,
    ClearFault,
    Flags,
    Hello,
    Home,
    Info,
    Message,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    State,
    Stop,
    microseconds_between,
    ticks_between,
    went_back,
)
from cartpole_rl.wire.frames import END

LOGGER = logging.getLogger(__name__)

Answer = TypeVar("Answer", bound=Message)

HALF_MILLISECOND = 500  # us
OVERTAKEN_TICKS = 16  # 0.3 s: nothing keeps a frame back for longer, and no cart boots and is driven so soon
BACKLOG_BYTES = 1000  # with more waiting, the system's buffer (4096) may have thrown newer bytes away
WATCHDOG_PERIODS = 3  # without a command, after which the cart sets its motor to 0
RESTARTED = "the cart has restarted; check its power"
UNACKNOWLEDGED_PERIODS = 1.5  # of a frame: by then the state after it has come, if the frame has


class SerialSettings(Settings):
    """How to reach a cart. Times in s."""

    port: str  # /dev/ttyUSB0, COM3, a URL of pyserial, or auto: the only cart that is plugged in
    baud: Count = 921600  # 115200 is allowed too
    timeout: Positive = 1.0  # without a state for so long, the link is lost
    connect_timeout: Positive = 3.0  # for the first answer; a board that restarts when opened needs about 1 s
    answer_timeout: Positive = 0.5  # for ACK or NACK, then the question is repeated
    retries: Annotated[int, Field(ge=0)] = 3  # repetitions of a question without an answer
    write_timeout: Positive = 0.2
    nudge_after: Positive = 0.5  # silence after which the host says HELLO


class SerialCart:
    """One cart on a serial port. A context manager: every way out first sets the motor to 0 and disarms.

        with SerialCart(SerialSettings(port="/dev/ttyUSB0")) as cart:
            cart.home()
            cart.start()
            for _ in range(50):
                print(cart.set_motor(100), cart.get_state())

    Counts and motor values are positive to the right. SIGTERM ends a Python process without leaving a `with`;
    a program that wants the cart disarmed at once turns it into an exception. If it does not, the cart's own
    watchdog sets the motor to 0 after three periods.

    Every method raises LinkError when the cart no longer answers.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self.settings = settings
        self.port = settings.port  # once opened, the one that "auto" was found to be
        self.statistics = LinkStatistics()
        self.flags = Flags(0)  # of the newest state
        self.restarts = 0  # of the cart, while the port was open
        self._open_link: SerialLink | None = None
        self._information: Info | None = None
        self._newest: State | None = None  # arrived, and not yet given to anyone
        self._newest_at = 0.0
        self._last: State | None = None  # the newest that came, given out or not
        self._stopped_clock: LinkError | None = None  # to be raised with the next state
        self._missing: set[int] = set()  # ticks that were counted as lost, and may still come late
        self._answers: deque[Message] = deque(maxlen=64)
        self._refused: Nack | None = None  # of a SET_MOTOR
        self._refused_sequence = -1  # of the newest frame that was refused; no state will acknowledge it
        self._state_since_refusal = True
        self._asked_sequence = 0  # of the newest question; a refusal of a motor value from before it is void
        self._driving = False  # states are being answered with motor values
        self._unanswered = False  # a state was returned and its command is not sent yet
        self._answering: State | None = None  # the state that was returned last
        self._overdue: State | None = None  # its command went out later than a period after it came
        self._catching_up = False  # what is missing now was thrown away while the host did something else
        self._measured = True  # latency and late ticks are counted
        self._commanded: tuple[int, State] | None = None  # sequence of a motor value, the state it answers

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def open(self) -> Info:
        """Open the port, shake hands, disarm; returns what the cart is.

        Raises PortError if the port cannot be opened, LinkError if no cart answers on it.
        """
        if self._open_link is not None:
            return self.information
        settings = self.settings
        self.port = resolved_port(settings.port)
        port = open_port(self.port, settings.baud, settings.write_timeout)
        driving, self.statistics = self.statistics, LinkStatistics()  # a boot banner is no fault of the link
        self._open_link = SerialLink(port, self.statistics)
        try:
            self._information = self._shake_hands()
            self.stop()
        except BaseException:
            self._abandon()
            raise
        finally:
            self.statistics = driving
            self._missing.clear()
        self._open_link.statistics = driving
        return self._information

    def close(self) -> None:
        """Motor to 0, disarm, give the port back. Never raises, so that no error hides another."""
        if self._open_link is None:
            return
        try:
            self.stop()
        except PlantError as error:
            LOGGER.warning(
                "the cart did not confirm that it is disarmed (%s); its watchdog stops it, unless it was "
                "homing: then switch it off",
                error,
            )
        finally:
            self._let_go(self._open_link)

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._open_link is not None

    @property
    def information(self) -> Info:
        """What the cart told when it last sent INFO, without asking again."""
        if self._information is None:
            raise LinkError(f"the cart on {self.port} was never reached: open() it first")
        return self._information

    def info(self) -> Info:
        """Ask the cart what it is: firmware, counts, limits, period."""
        self._information = self._request(Hello(), Info)
        return self._information

    def start(self) -> None:
        """Arm the motor. Every way to drive a cart goes through here.

        Raises NotReadyError if INFO describes another kind of cart than the one that is driven here,
        RefusedError if the cart is not homed, FaultError if a fault is latched.
        """
        check_scales(self.information)
        check_limits(self.information)
        self._request(Start(), Ack)

    def stop(self) -> None:
        """Motor to 0 and disarm; ends a homing. The bytes go out before anything that can block."""
        self._request(Stop(), Ack, before=(SetMotor(0),))

    def clear_fault(self) -> None:
        """Clear the latched faults. Raises FaultError, naming them, if the cause of one is still there."""
        self._request(ClearFault(), Ack)
        state = self._state_since_question()
        if state.fault:
            raise fault_error(state.fault)

    def set_period(self, period_us: int) -> Info:
        """Set the control period in us, 5000 to 100000, while disarmed. Raises RefusedError otherwise."""
        answer = self._request(SetPeriod(period_us), Info, lambda info: info.period_us == period_us)
        self._information = answer
        return answer

    def home(self, timeout: float = 120.0) -> State:
        """Home, and wait until it is done: zeros set, the cart in the middle, the pole hanging still.

        Returns the state after it; `information` then has the limits that follow from the measured span.
        Raises FaultError if homing fails, PlantError if it takes longer than `timeout` seconds, LinkError if
        the cart restarts meanwhile.
        """
        try:
            self._request(Home(), Ack)
        except RefusedError as error:
            if error.reason != Reason.BUSY or not self._is_homing():
                raise  # otherwise only the ACK was lost
        deadline, restarts = time.perf_counter() + timeout, self.restarts
        state = self._state_since_question()
        while True:
            if state.fault:
                raise fault_error(state.fault)
            if self.restarts > restarts:
                raise LinkError(RESTARTED)
            if self.flags & Flags.HOMED and not self.flags & Flags.HOMING:
                self.info()  # the limits are now those of the span that was measured
                return self.get_state()
            if time.perf_counter() > deadline:
                self.stop()
                raise PlantError(
                    f"homing was not done after {timeout:g} s: clear the track, let the pole hang"
                )
            state = self._current_state()

    def set_motor(self, value: int) -> int:
        """Send a motor value; returns what was sent.

        That is `value` within the cart's limits, or 0 where it answers a state from so long ago that the
        cart's watchdog has stopped the motor. Raises LinkError where that was longer ago than `timeout`.
        """
        link = self._link
        limit = max(0, self.information.motor_limit)  # whatever INFO says, 0 stays 0
        sent = self._in_time(max(-limit, min(limit, int(value))))
        self._refused_sequence = -1
        link.send(SetMotor(sent))
        if self._unanswered:
            self._unanswered = False
            if self._measured:
                self._driving = True
                self._commanded = None if self._answering is None else (link.sequence, self._answering)
                delay = link.sent_at - self._newest_at
                self.statistics.latency.add(delay)
                self._overdue = self._answering if delay > self.information.period_us * 1e-6 else None
        return sent

    def _in_time(self, motor: int) -> int:
        """The motor value, or 0 where it is too late for it; see `set_motor`.

        If no newer state waits, no time has passed for the cart, as on a lockstep emulator.
        """
        if not motor or not self._unanswered or not self._link.waiting():
            return motor
        late = time.perf_counter() - self._newest_at
        if late > self.settings.timeout:  # somebody may have moved the cart meanwhile
            raise LinkError(
                f"this computer did not answer the cart on {self.port} for {late:.1f} s; end what keeps it "
                "busy, and do not suspend a command that drives"
            )
        return 0 if late > WATCHDOG_PERIODS * self.information.period_us * 1e-6 else motor

    @contextmanager
    def unmeasured(self) -> Iterator[None]:
        """Within it, commands count neither as latencies nor as late: the host's own small moves."""
        self._measured = False
        try:
            yield
        finally:
            self._measured = True

    def get_state(self) -> State:
        """Wait for the newest state that was measured after the cart took the last frame sent.

        A state with a latched fault is returned, not raised. Raises RefusedError or FaultError if the cart
        refused the last motor value, LinkError if no state comes within `timeout`.
        """
        if self._notice_backlog():
            self._link.send(Hello())  # and only a state that acknowledges it is newer than the backlog
        return self._current_state()

    def poll_state(self) -> State:
        """Say HELLO and wait for a state: for waiting at a cart that moves only when spoken to."""
        self._link.send(Hello())
        return self.get_state()

    def _notice_backlog(self) -> bool:
        """Whether so much waits that newer states may have been thrown away: those do not count as lost."""
        backlog = self._link.waiting() > BACKLOG_BYTES
        self._catching_up |= backlog
        return backlog

    def _is_homing(self) -> bool:
        self.poll_state()
        return bool(self.flags & Flags.HOMING)

    @property
    def _link(self) -> SerialLink:
        if self._open_link is None:
            raise LinkError(f"the port {self.port} is not open: use `with SerialCart(...) as cart`")
        return self._open_link

    def _abandon(self) -> None:
        """`close` without waiting for an answer: whatever is there may be no cart."""
        link = self._link
        try:
            with suppress(LinkError):
                link.send(SetMotor(0), Stop())
        finally:
            self._let_go(link)

    def _let_go(self, link: SerialLink) -> None:
        self._open_link = self._newest = self._last = self._refused = None
        self._missing.clear()
        link.close()

    def _shake_hands(self) -> Info:
        """Say hello until the cart answers; whatever a booting board prints before is passed over."""
        deadline = time.perf_counter() + self.settings.connect_timeout
        pause = min(self.settings.answer_timeout, self.settings.connect_timeout)
        while time.perf_counter() < deadline:
            self._answers.clear()
            self._link.write(END)  # ends whatever the cart has taken for the beginning of a frame
            self._link.send(Hello())
            until = min(deadline, time.perf_counter() + pause)
            answer = self._await_answer(until, (), Info, lambda info: True)
            if answer is not None:
                return answer
        raise LinkError(f"no cart answers on {self.port}: {self._what_came()}")

    def _what_came(self) -> str:
        link = self._link
        if link.bytes_received == 0:
            return "nothing came; is it powered, and is this the right port?"
        if not link.why_bad:
            return f"{link.bytes_received} bytes came but no frame; is {self.settings.baud} its baud rate?"
        return (
            f"{link.bytes_received} bytes came, the last bad frame: {link.why_bad}; right port, right baud?"
        )

    def _request(
        self,
        message: Message,
        kind: type[Answer],
        fits: Callable[[Answer], bool] = lambda answer: True,
        before: tuple[Message, ...] = (),
    ) -> Answer:
        """Send `message` until the cart answers it. Raises what a NACK says; LinkError without an answer."""
        self._driving = self._unanswered = False
        self._overdue = self._commanded = None
        self._refused_sequence = -1
        self._answers.clear()
        asked: list[int] = []
        for _ in range(1 + self.settings.retries):
            asked.append(self._link.send(*before, message))
            self._notice_backlog()
            self._asked_sequence = asked[-1]
            answer = self._await_answer(time.perf_counter() + self.settings.answer_timeout, asked, kind, fits)
            if answer is not None:
                self._refused = None  # of a motor value from before; it has no meaning any more
                return answer
        raise LinkError(
            f"the cart on {self.port} did not answer {message.TYPE.name}, asked {len(asked)} times: "
            "check its cable and power"
        )

    def _await_answer(
        self, deadline: float, asked: Sequence[int], kind: type[Answer], fits: Callable[[Answer], bool]
    ) -> Answer | None:
        while True:
            for answer in self._answers:
                if isinstance(answer, Ack | Nack) and answer.sequence not in asked:
                    continue
                if isinstance(answer, Nack):
                    raise refusal(answer)
                if isinstance(answer, kind) and fits(answer):
                    return answer
            if time.perf_counter() >= deadline:
                return None
            self._answers.clear()
            self._pump()

    def _current_state(self) -> State:
        """`get_state` without the question after a backlog."""
        state = self._await_current(time.perf_counter() + self.settings.timeout)
        stopped_clock, self._stopped_clock = self._stopped_clock, None
        if stopped_clock is not None:
            raise stopped_clock
        refused, self._refused = self._refused, None
        if refused is not None and not state.fault:
            raise refusal(refused)
        self._count_overdue(state)
        self._time_loop(state)
        self._catching_up, self._unanswered, self._answering = False, True, state
        return state

    def _state_since_question(self) -> State:
        """The first state that was measured after the cart took the newest question. Raises LinkError."""
        deadline = time.perf_counter() + self.settings.timeout
        while True:
            state = self._current_state()
            if (state.last_sequence - self._asked_sequence) % 256 < 128:
                return state
            if time.perf_counter() > deadline:
                raise LinkError(
                    f"the states of the cart on {self.port} acknowledge no frame; correct its firmware"
                )

    def _await_current(self, deadline: float) -> State:
        """The newest state that acknowledges the last frame; when that is overdue, the newest there is."""
        older: State | None = None
        while True:
            while self._link.waiting():
                self._pump()
            if self._newest is None:
                self._pump()
            state, self._newest = self._newest, None
            if state is not None and older is not None:
                self._count_late()
            older = state or older
            if older is None:
                self._endure_silence(deadline)
            elif self._is_current(older):
                return older

    def _is_current(self, state: State) -> bool:
        """Whether the state was measured after the cart took the last frame, or that frame must be lost."""
        link = self._link
        if link.sequence == state.last_sequence:
            return True
        if link.sequence == self._refused_sequence and self._state_since_refusal:
            return True
        waited = time.perf_counter() - link.sent_at
        return waited > UNACKNOWLEDGED_PERIODS * min(self.information.period_us, LONGEST_PERIOD_US) * 1e-6

    def _endure_silence(self, deadline: float) -> None:
        """Raise LinkError after the deadline; say HELLO after each `nudge_after` seconds without a byte."""
        now = time.perf_counter()
        if now > deadline:
            raise LinkError(
                f"no state came from {self.port} for {self.settings.timeout:g} s: "
                "check the cart's cable and power"
            )
        if now - max(self._link.received_at, self._link.sent_at) > self.settings.nudge_after:
            self._link.send(Hello())

    def _pump(self) -> None:
        """Take in what has come; wait a little for a first byte."""
        for frame in self._link.receive():
            message = frame.message
            if isinstance(message, State):
                self._take_state(message, Flags(frame.flags))
            elif isinstance(message, Nack):
                self._take_refusal(message)
            else:
                self._answers.append(message)

    def _take_refusal(self, nack: Nack) -> None:
        self._refused_sequence = nack.sequence
        self._state_since_refusal = False
        if nack.type == MessageType.SET_MOTOR:
            if (nack.sequence - self._asked_sequence) % 256 < 128:
                self._refused = nack  # nobody waits for its answer
        else:
            self._answers.append(nack)

    def _take_state(self, state: State, flags: Flags) -> None:
        """Keep the state as the newest, unless a newer one is here; count those missing before it."""
        last = self._last
        if last is not None:
            if ticks_between(state.tick, last.tick) < OVERTAKEN_TICKS:
                self._count_overtaken(state.tick)
                return
            ticks = ticks_between(last.tick, state.tick)
            if went_back(ticks):
                self.restarts += 1
            else:
                self._check_clock(last, state, ticks)
                self._count_missing(state.tick, ticks - 1)
        if self._newest is not None:
            self._count_late()
        self._last = state
        self._newest = state
        self._state_since_refusal = True
        self._newest_at = self._link.received_at
        self.flags = flags

    def _check_clock(self, last: State, state: State, ticks: int) -> None:
        """Note it if the cart's clock did not advance between two states: no velocity follows.

        After 36 minutes without a state the clock may have wrapped, and tells nothing.
        """
        if self._information is None:  # before the first INFO nobody knows how long a period is
            return
        passed = microseconds_between(last.time_us, state.time_us)
        long_ago = went_back(ticks * min(self._information.period_us, LONGEST_PERIOD_US))
        if passed == 0 or (went_back(passed) and not long_ago):
            self._stopped_clock = LinkError(
                f"the clock of the cart on {self.port} does not advance: STATE {last.tick} is of "
                f"{last.time_us} us, STATE {state.tick} of {state.time_us} us; correct its firmware"
            )

    def _count_missing(self, tick: int, states: int) -> None:
        """States before `tick` that did not come: lost on the way, or thrown away while the host was busy."""
        if not self._catching_up:
            self.statistics.lost_frames += states
            newest = min(states, OVERTAKEN_TICKS)
            missing = self._missing | {ticks_between(age, tick) for age in range(1, newest + 1)}
            self._missing = {each for each in missing if ticks_between(each, tick) < OVERTAKEN_TICKS}
        elif self._driving:
            self.statistics.late_ticks += states

    def _count_overtaken(self, tick: int) -> None:
        """A state that a newer one has overtaken, and so was not lost; or one that came before, once more."""
        if tick in self._missing:
            self._missing.remove(tick)
            seen = self.statistics
            seen.lost_frames = max(0, seen.lost_frames - 1)  # its loss may not have been counted
            self.statistics.overtaken_frames += 1
        else:
            self.statistics.repeated_frames += 1

    def _count_overdue(self, state: State) -> None:
        """A state whose command took over a period, if by the cart's clock too more than one lies between."""
        overdue, self._overdue = self._overdue, None
        if overdue is not None and ticks_between(overdue.tick, state.tick) != 1:
            self.statistics.late_ticks += 1

    def _time_loop(self, state: State) -> None:
        """Note how long after a state was measured the command chosen on it came to the cart.

        The state tells the command's age in whole milliseconds, half of one less than it is on average.
        """
        commanded, self._commanded = self._commanded, None
        if commanded is None or state.last_sequence != commanded[0]:
            return
        passed_us = microseconds_between(commanded[1].time_us, state.time_us)
        if not went_back(passed_us):  # otherwise the cart has restarted
            since_us = passed_us - 1000 * state.command_age_ms
            self.statistics.loop_times.add(max(0, since_us - HALF_MILLISECOND) * 1e-6)

    def _count_late(self) -> None:
        """A state nobody acted on; while the host asks other things than motor values, that is no delay."""
        if self._driving:
            self.statistics.late_ticks += 1
