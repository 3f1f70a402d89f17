"""One open connection to a cart: questions, their answers, and the newest state.

A question is repeated until the cart answers it with ACK, NACK or INFO. A motor value is not: the cart
acknowledges it in its next STATE, which has the sequence of the last frame taken.

`current_state` returns the newest state, and only one that was measured after the cart took the last frame,
so that a loop never mistakes an older state for the effect of its command. A frame that was lost is never
acknowledged; one and a half periods after it was sent the newest state is returned anyway.

If nothing arrives for `nudge_after` seconds, the host sends HELLO: a lockstep emulator, which advances by one
period per frame, continues after a lost frame. A cart that is known to have its own clock gets none: an
accepted frame lets a policy on its board drive on, and the host would not see where to.

A motor value names the state that it answers. The cart refuses one that answers an old state, wherever it
was delayed. The link then counts as broken, unless the cart has taken a newer frame.
"""

import math
import statistics
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import TypeVar

from cartpole_rl.errors import LinkError
from cartpole_rl.plants.serial.errors import LONGEST_PERIOD_US, refusal
from cartpole_rl.plants.serial.link import SerialLink, WriteTimeoutError, now
from cartpole_rl.plants.serial.tracking import StateTracker, is_newer
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.terminal import beat
from cartpole_rl.wire.frames import END, OTHER_VERSION
from cartpole_rl.wire.messages import (
    Ack,
    Flags,
    Hello,
    Info,
    Message,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    Start,
    StartPolicy,
    State,
    Stop,
)

Answer = TypeVar("Answer", bound=Message)

WATCHDOG_PERIODS = 3  # after a state was measured, the cart takes no motor value that answers it
BACKLOG_BYTES = 1000  # with more waiting, the system's buffer (4096) may have dropped newer bytes
UNACKNOWLEDGED_PERIODS = 1.5  # after a frame: by then the next state has come, if the frame has arrived
LISTENING_PERIODS = 8  # without a frame, to learn whether the cart has a clock of its own
LONGEST_DEAFNESS = 1.0  # s; the cart's watchdog has stopped its motor long before
KEPT_ANSWERS = 64
ROUND_TRIPS = 5
ACKNOWLEDGED_STOPS = 2  # one acknowledgement may be left over from the last host


class Connection:
    """Questions, answers and states over `link`. Every method raises LinkError if the cart is gone."""

    def __init__(self, link: SerialLink, settings: SerialSettings, tracker: StateTracker) -> None:
        self.link = link
        self._settings = settings
        self._tracker = tracker
        self._answers: deque[Message] = deque(maxlen=KEPT_ANSWERS)
        self._asked_sequence = 0  # of the newest question
        self._frames_asked = 0  # sent up to that question; refusals of motor values among them are void
        self._heard: int | None = None  # the newest sequence that a state acknowledged, ...
        self._unheard_since: float | None = None  # ... and when a newer one was sent
        self._newest_heard: int | None = None  # by any state since the newest question
        self._motor_sequence = 0  # of the newest motor value
        self._refused: Nack | None = None  # of a motor value
        self._refused_sequence = -1  # of the newest frame that was refused; no state will acknowledge it
        self._state_since_refusal = True

    def shake_hands(self) -> Info:
        """Send STOP until the cart answers it, then HELLO. A booting board may print, or take no bytes.

        STOP comes first: a host that died may have left the cart armed, with a policy on its board that any
        accepted frame wakes. HELLO waits for its answer, as STOP may be lost.
        """
        deadline = now() + self._settings.connect_timeout
        pause = min(self._settings.answer_timeout, self._settings.connect_timeout)
        stops: list[int] = []
        stopped = 0
        while now() < deadline:
            self._answers.clear()
            try:
                self.link.write(END)  # ends a partial frame that the cart may have read
                sent = self.link.send(Stop() if stopped < ACKNOWLEDGED_STOPS else Hello())
            except WriteTimeoutError:
                if now() < deadline:
                    continue
                raise
            until = min(deadline, now() + pause)
            if stopped < ACKNOWLEDGED_STOPS:
                stops.append(sent)
                answer = self._await_answer(until, Stop.TYPE, stops, Ack)
                if answer is not None:
                    stopped += 1
                    stops.remove(answer.sequence)
                continue
            information = self._await_answer(until, Hello.TYPE, (), Info)
            if information is not None:
                return information
        raise LinkError(f"no cart answers on {self.link.port}: {self._what_came()}")

    def request(
        self,
        message: Message,
        kind: type[Answer],
        fits: Callable[[Answer], bool] = lambda answer: True,
        before: tuple[Message, ...] = (),
        within: float = math.inf,
    ) -> Answer:
        """Send `before` and `message` until the cart answers `message`; return the answer.

        The question is repeated `settings.retries` times or, if `within` is given, for `within` s, also where
        the port takes no bytes for a while.
        Raises RefusedError or FaultError for a NACK, LinkError without an answer.
        """
        self._tracker.send_question()
        self._refused_sequence = -1
        self._newest_heard = None
        self._answers.clear()
        asked: list[int] = []
        end, pause = now() + within, self._settings.answer_timeout
        attempts: Iterable[int] = range(1 + self._settings.retries)
        if math.isfinite(within):
            attempts, pause = count(), min(pause, within / 2)
        for _ in attempts:
            try:
                asked.append(self.link.send(*before, message))
            except WriteTimeoutError:
                if now() + self._settings.write_timeout < end < math.inf:
                    continue
                raise
            self.notice_backlog()
            self._asked_sequence, self._frames_asked = asked[-1], self.link.frames_sent
            deadline = min(end, now() + pause)
            answer = self._await_answer(deadline, message.TYPE, asked, kind, fits)
            if answer is not None:
                self._refused = None  # of an earlier motor value, which has no meaning any more
                if isinstance(answer, Ack):
                    self._asked_sequence = answer.sequence  # a repetition may still be refused
                return answer
            if deadline == end:
                break
        raise LinkError(
            f"the cart on {self.link.port} did not answer {message.TYPE.name}, asked {len(asked)} times: "
            "check its cable and power"
        )

    def arm(self, message: Start | StartPolicy) -> None:
        """Arm the motor; from then on no state from before it is handed out. Raises as `request` does."""
        self.request(message, Ack)
        self._tracker.begin_drive(self._asked_sequence)

    def learn_clock(self) -> None:
        """Send nothing for as long as a disarmed cart with its own clock needs to be known as one.

        Only states that acknowledge the newest frame tell. If none comes, that frame was lost or refused, or
        the link is slow: then HELLO is sent, and its state waited for. Without one the clock stays unknown.
        """
        tracker, link = self._tracker, self.link
        tracker.send_question()
        tracker.is_lockstep = False
        listening = LISTENING_PERIODS * self._period_us * 1e-6
        begin, deadline, asked = now(), math.inf, False
        while not tracker.ticks_alone:
            self._read()
            moment, newest = now(), tracker.last
            if newest is not None and newest.last_sequence == link.sequence:
                deadline = min(deadline, moment + max(listening, moment - link.sent_at))
                limit = deadline + self._settings.timeout  # a device may never pause
                if moment >= deadline and (not link.waiting() or moment >= limit):
                    tracker.is_lockstep = True
                    return
            elif moment - begin > (self._settings.answer_timeout if asked else listening):
                if asked:
                    return
                link.send(Hello())
                begin, deadline, asked = moment, math.inf, True

    def round_trip(self) -> float:
        """Return the time in s from a STOP to its answer, the median of several. The cart is disarmed."""
        times = []
        for _ in range(ROUND_TRIPS):
            started = now()
            self.request(Stop(), Ack)
            times.append(now() - started)
        return statistics.median(times)

    def send_motor(self, value: int) -> None:
        """Send a motor value once, as the answer to the state that was returned last."""
        self._refused_sequence = -1
        self._motor_sequence = self.link.send(SetMotor(value, self._tracker.answered_tick))
        self._tracker.send_command(self.link.sequence, self.link.sent_at)

    def current_state(self) -> State:
        """Wait for the newest state that was measured after the cart took the last frame.

        Raises RefusedError or FaultError if the cart refused the last motor value, LinkError if no state
        arrives within `timeout`, the cart's clock stands still or has a wrong rate, its motor value is none,
        or the cart does not hear this computer or hears it too late.
        """
        state = self._await_current(now() + self._settings.timeout)
        self._check_clock()
        self._check_motor(state)
        self._check_hearing(state)
        refused, self._refused = self._refused, None
        if refused is not None and not state.fault and not self._was_overtaken(refused):
            raise refusal(refused)
        self._tracker.hand_out(state)
        return state

    def _was_overtaken(self, refused: Nack) -> bool:
        """Return True if a motor value came late behind a newer frame that was taken, or came twice."""
        newest = self._newest_heard
        return refused.reason == Reason.STALE and newest is not None and is_newer(newest, refused.sequence)

    def _check_motor(self, state: State) -> None:
        """Raise LinkError if the cart reports a motor value that no cart has: it would be learned from."""
        if abs(state.motor_applied) > LARGEST_MOTOR:
            raise LinkError(
                f"STATE {state.tick} of the cart on {self.link.port} has motor value {state.motor_applied}, "
                f"which is beyond {LARGEST_MOTOR}; correct its firmware"
            )

    def _check_hearing(self, state: State) -> None:
        """Raise LinkError if frames went out but, for LONGEST_DEAFNESS, no state has acknowledged one."""
        newest, heard, self._heard = self.link.sequence, self._heard, state.last_sequence
        if state.last_sequence == newest or newest == self._refused_sequence:
            self._unheard_since = None
        elif self._unheard_since is None or state.last_sequence != heard:
            self._unheard_since = self.link.sent_at
        elif now() - self._unheard_since > LONGEST_DEAFNESS:
            raise LinkError(
                f"the cart on {self.link.port} sends states but acknowledges nothing: check the wire from "
                "this computer to the cart"
            )

    def state_since_question(self) -> State:
        """Wait for a state that was measured after the cart took the newest question."""
        deadline = now() + self._settings.timeout
        while True:
            state = self.current_state()
            if is_newer(state.last_sequence, self._asked_sequence):
                return state
            if now() > deadline:
                raise LinkError(
                    f"the states of the cart on {self.link.port} acknowledge no frame; correct its firmware"
                )

    def took_motor(self, state: State) -> bool:
        """Return True if the newest motor value was the last frame that the cart had taken before `state`."""
        return state.last_sequence == self._motor_sequence

    def notice_backlog(self) -> bool:
        """Return True if so many bytes wait that newer states may have been dropped: they are not lost."""
        backlog = self.link.waiting() > BACKLOG_BYTES
        if backlog:
            self._tracker.catch_up()
        return backlog

    def _await_answer(
        self,
        deadline: float,
        asked_type: MessageType,
        asked: Sequence[int],
        kind: type[Answer],
        fits: Callable[[Answer], bool] = lambda answer: True,
    ) -> Answer | None:
        overdue = False
        while True:
            for answer in self._answers:
                if isinstance(answer, Ack | Nack) and (
                    answer.type != asked_type or answer.sequence not in asked
                ):
                    continue
                if isinstance(answer, Nack):
                    raise refusal(answer)
                if isinstance(answer, kind) and fits(answer):
                    return answer
            late = now() >= deadline
            waiting = self.link.waiting()
            if late and (overdue or not waiting):
                return None
            overdue = late  # what waits is read once more: this computer may have paused
            self._answers.clear()
            self._read(waiting)

    def _await_current(self, deadline: float) -> State:
        """The newest state that acknowledges the last frame; when that is overdue, the newest there is."""
        older: State | None = None
        while True:
            while (waiting := self.link.waiting()) and now() < deadline:  # a device may never pause
                self._read(waiting)
            state = self._tracker.take_newest()
            if state is None:
                beat()
                self._read()
                if self.link.waiting() and now() < deadline:
                    continue  # this computer may have paused since it read: newer states wait
                state = self._tracker.take_newest()
            if state is not None and older is not None:
                self._tracker.count_passed_over()
            older = state or older
            if older is None:
                self._endure_silence(deadline)
            elif self._is_current(older):
                return older

    def _is_current(self, state: State) -> bool:
        """Return True if the state was measured after the last frame arrived, or if that frame is lost."""
        link = self.link
        if link.sequence == state.last_sequence:
            return True
        if link.sequence == self._refused_sequence and self._state_since_refusal:
            return True
        return now() - link.sent_at > UNACKNOWLEDGED_PERIODS * self._period_us * 1e-6

    @property
    def _period_us(self) -> int:
        return min(self._tracker.period_us or LONGEST_PERIOD_US, LONGEST_PERIOD_US)

    def _endure_silence(self, deadline: float) -> None:
        """Raise LinkError after the deadline; send HELLO after each `nudge_after` seconds without a byte."""
        moment = now()
        if moment > deadline:
            raise LinkError(
                f"no state came from {self.link.port} for {self._settings.timeout:g} s: "
                "check the cart's cable and power"
            )
        silent = moment - max(self.link.received_at, self.link.sent_at)
        if silent > self._settings.nudge_after and not self._tracker.ticks_alone:
            self.link.send(Hello())

    def _read(self, waiting: int = 0) -> None:
        """Take in the bytes that are `waiting`; if none are, wait a little for the first."""
        for frame in self.link.receive(waiting):
            message = frame.message
            if isinstance(message, State):
                if self._newest_heard is None or is_newer(message.last_sequence, self._newest_heard):
                    self._newest_heard = message.last_sequence
                if self._tracker.receive(
                    message, Flags(frame.flags), self.link.received_at, self.link.sequence
                ):
                    self._state_since_refusal = True
            elif isinstance(message, Nack):
                self._take_refusal(message)
            else:
                self._answers.append(message)

    def _take_refusal(self, nack: Nack) -> None:
        self._refused_sequence = nack.sequence
        self._state_since_refusal = False
        if nack.type != MessageType.SET_MOTOR:
            self._answers.append(nack)
        elif (self.link.sequence - nack.sequence) % 256 < self.link.frames_sent - self._frames_asked:
            self._refused = nack  # `current_state` raises it

    def _check_clock(self) -> None:
        """Raise LinkError if the cart's clock has stood still, or its rate is wrong."""
        stopped, self._tracker.stopped_clock = self._tracker.stopped_clock, None
        if stopped is not None:
            last, state = stopped
            raise LinkError(
                f"the clock of the cart on {self.link.port} does not advance: STATE {last.tick} is of "
                f"{last.time_us} us, STATE {state.tick} of {state.time_us} us; correct its firmware"
            )
        rate, self._tracker.wrong_rate = self._tracker.wrong_rate, None
        if rate is not None:
            raise LinkError(
                f"the clock of the cart on {self.link.port} passes {rate:.3f} s in a second of this "
                "computer, so all speeds would be wrong: correct the timer in its firmware"
            )

    def _what_came(self) -> str:
        link = self.link
        if link.bytes_received == 0:
            return "nothing came; is it powered, and is this the right port?"
        if OTHER_VERSION in link.why_bad:
            return f"{link.why_bad}: update its firmware, or this program"
        if not link.why_bad:
            return f"{link.bytes_received} bytes came but no frame; is {self._settings.baud} its baud rate?"
        return (
            f"{link.bytes_received} bytes came, the last bad frame: {link.why_bad}; right port, right baud?"
        )
