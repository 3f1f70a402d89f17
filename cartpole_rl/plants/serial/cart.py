"""The host's side of a cart on a serial port: the four calls of the original cart, and a few more.

The cart sets the pace: it sends a STATE each period, and the host answers with one motor value.
`connection.py` has the rules by which a state counts as the answer to a command, `tracking.py` those by
which states count as lost, repeated or late. The protocol is described in `docs/protocol.md`.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Self

from cartpole_rl.errors import LinkError, PlantError, PortError
from cartpole_rl.plants.serial.connection import WATCHDOG_PERIODS, Connection
from cartpole_rl.plants.serial.errors import RefusedError, check_limits, check_rig, fault_error
from cartpole_rl.plants.serial.link import SerialLink, now
from cartpole_rl.plants.serial.port import UsbPort, found_ports, is_name_of, open_port, port_of, resolved_port
from cartpole_rl.plants.serial.tracking import LinkStatistics, StateTracker
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.rig.hardware import Hardware, nominal_hardware
from cartpole_rl.terminal import waiting
from cartpole_rl.wire.messages import (
    Ack,
    ClearFault,
    Flags,
    Hello,
    Home,
    Info,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
    microseconds_between,
)

if TYPE_CHECKING:
    from cartpole_rl.plants.emulated import CartProcess

LOGGER = logging.getLogger(__name__)

LONGEST_SUSPENSION = 1.0  # s without an answer of this computer, after which a person may have moved the cart
LONGEST_STOP = 3.0  # s to wait for the answer to STOP, whatever the settings: signals.UNWINDING is longer
LAST_STOP = 0.5  # s to wait for it in `close` if the STOP before was not answered
LEASE_RENEWAL_US = 100_000  # of the cart's clock between two HELLOs, without which it ends homing
SLOW_LINK_ATTEMPTS = 3  # to measure a round trip of less than a period, as this computer may be busy
RESTARTED = "the cart has restarted; check its power"


class SerialCart:
    """One cart on a serial port. A context manager: every way out first sets the motor to 0 and disarms.

        with SerialCart(SerialSettings(port="/dev/ttyUSB0")) as cart:
            cart.home()
            cart.start()
            for _ in range(50):
                print(cart.set_motor(100), cart.get_state())

    Counts and motor values are positive to the right. SIGTERM ends a Python process without leaving a `with`;
    a program that drives a cart turns it into an exception (`cartpole_rl.signals.RaiseOnce`). If it does not,
    the cart sets its motor to 0 by itself: after three periods, or after half a second while it homes.

    Every method raises LinkError when the cart no longer answers.
    """

    def __init__(
        self,
        settings: SerialSettings,
        hardware: Hardware | None = None,
        before_homing: Callable[[], None] = lambda: None,
        server: "CartProcess | None" = None,
    ) -> None:
        """`hardware` is that of the cart's file, ip02's if it is None. `before_homing` may ask a person.

        `server` is the process that serves the port, if there is one: once it has ended, it says why.
        """
        self.settings, self.hardware = settings, hardware or nominal_hardware()
        self._server = server
        self._before_homing = before_homing
        self.port = settings.port  # once opened, the one that "auto" was resolved to
        self._usb: UsbPort | None = None  # the cart's device, once it answered, if it is on USB
        self._tracker = StateTracker()
        self._open_connection: Connection | None = None
        self._information: Info | None = None
        self._stop_unanswered = False
        self._looked_again = False  # a cart without a clock had more time to show one, before it moved
        self._required_policy: int | None = None  # identity of the only agent that may drive from the board

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> Info:
        """Open the port, shake hands, disarm, learn whether the cart has a clock of its own; return INFO.

        Raises PortError if the port cannot be opened, LinkError if no cart answers on it, PlantError if its
        board has another agent than `check_policy` required. After a lost link another USB device than before
        is not opened.
        """
        if self._open_connection is not None:
            return self.information
        settings, server = self.settings, self._server
        if server is not None and server.died:
            raise LinkError(server.died)  # its port may be another process's by now
        self.port = port_of(self._usb, settings.port) if self._usb else resolved_port(settings.port)
        try:
            port = open_port(self.port, settings.baud, settings.write_timeout)
        except PortError as error:
            if server is not None and (why := server.death()):
                raise LinkError(why) from error
            raise
        self._looked_again = False
        with self._tracker.uncounted() as uncounted:
            link = SerialLink(port, uncounted, server)
            self._open_connection = Connection(link, settings, self._tracker)
            try:
                self._note(self._open_connection.shake_hands())
                self.stop()
                self._open_connection.learn_clock()
            except BaseException:
                self._abandon()
                raise
        link.statistics = self.statistics
        self._usb = self._usb or next((x for x in found_ports() if is_name_of(self.port, x.device)), None)
        if self._required_policy is not None:
            self.check_policy(self._required_policy)
        return self.information

    def close(self) -> None:
        """Set the motor to 0, disarm, give the port back. Raises only what interrupts it, such as Ctrl-C."""
        if self._open_connection is None:
            return
        told = self._server is not None and self._server.told
        try:
            self._stop(LAST_STOP if self._stop_unanswered else LONGEST_STOP)
        except PlantError as error:
            if not told:  # by a bridge that ended; it says whether the motor may be on
                LOGGER.warning(
                    "the cart did not confirm that it is disarmed (%s): its motor may still be on", error
                )
        except BaseException:  # a signal, before STOP was answered
            with suppress(PlantError):
                self._stop(LAST_STOP)
            raise
        finally:
            self._disconnect(self._open_connection)

    @property
    def is_lockstep(self) -> bool:
        """Whether the cart is known to wait for frames, as an emulator does on which no time passes."""
        return self._tracker.is_lockstep and not self._tracker.ticks_alone

    @property
    def is_open(self) -> bool:
        """True while the port is open."""
        return self._open_connection is not None

    @property
    def information(self) -> Info:
        """The newest INFO of the cart, without asking again."""
        if self._information is None:
            raise LinkError(f"the cart on {self.port} is not connected yet: call open() first")
        return self._information

    @property
    def flags(self) -> Flags:
        """Flags of the newest state."""
        return self._tracker.flags

    @property
    def restarts(self) -> int:
        """Restarts of the cart while the port was open."""
        return self._tracker.restarts

    @property
    def statistics(self) -> LinkStatistics:
        """Frames and times over all connections, without those of opening the port."""
        return self._tracker.statistics

    def info(self) -> Info:
        """Ask the cart for INFO: firmware, counts, limits, period."""
        return self._note(self._connection.request(Hello(), Info))

    def start(self) -> None:
        """Arm the motor. Every way to drive a cart from this computer goes through here.

        Raises NotReadyError if INFO describes another kind of cart than the one that is driven here,
        RefusedError if the cart is not homed, FaultError if a fault is latched, LinkError if the link takes
        longer than a period.
        """
        self._arm(Start())

    def check_policy(self, identity: int) -> None:
        """Raise PlantError unless the board has the agent of this `identity`.

        From then on `open` and `start_policy` check it too: after a lost link another board may answer.
        """
        self._required_policy = identity
        on_board = self.information.policy
        if on_board == 0:
            raise PlantError(
                "the cart's board has no policy: compile its firmware with one (docs/firmware.md)"
            )
        if on_board != identity:
            raise PlantError(
                f"the cart's board has another agent ({on_board:08x}, not {identity:08x}), or one for a pole "
                "of another length: export this one with cartpole-export format=c and compile the firmware "
                "with it"
            )

    def start_policy(self) -> None:
        """Arm the motor and let the policy on the board drive, while `follow_policy` keeps it from stopping.

        Raises what `start` raises, RefusedError if the board has no policy, and PlantError if it has another
        one than `check_policy` required.
        """
        if self._required_policy is not None:
            self.info()
            self.check_policy(self._required_policy)
        self._arm(StartPolicy())
        self._tracker.follow_policy()

    def stop(self) -> None:
        """Set the motor to 0 and disarm; ends a homing. The bytes go out before anything that can block."""
        self._stop(LONGEST_STOP)

    def clear_fault(self) -> None:
        """Clear the latched faults. Raises FaultError, naming them, if the cause of one is still there."""
        self._connection.request(ClearFault(), Ack)
        state = self._connection.state_since_question()
        if state.fault:
            raise fault_error(state.fault)

    def set_period(self, period_us: int) -> Info:
        """Set the control period in us, 5000 to 100000, while disarmed. Raises RefusedError otherwise."""
        return self._note(
            self._connection.request(SetPeriod(period_us), Info, lambda info: info.period_us == period_us)
        )

    def home(self, watch: Callable[[State], None] = lambda state: None) -> State:
        """Home, and wait until it is done: zeros set, the cart in the middle, the pole hanging still.

        Returns the state after it; `information` then has the limits that follow from the measured span.
        `watch` is called with each state on the way.
        Raises NotReadyError before the cart moves if it is not the one of its file. Raises FaultError if
        homing fails, PlantError if it takes longer than `settings.home_timeout`, LinkError if the cart
        restarts meanwhile.
        """
        check_rig(self.information, self.flags, self.hardware)
        self._before_homing()
        with waiting("homing: the cart moves by itself, usually for 15 to 40 s", thread=False):
            return self._homed(watch)

    def _homed(self, watch: Callable[[State], None]) -> State:
        self._check_round_trip()
        before = self._tracker.last
        timeout, restarts = self.settings.home_timeout, self.restarts
        deadline = now() + timeout
        while True:
            try:
                self._connection.request(Home(), Ack)
                break
            except RefusedError as error:
                if error.reason != Reason.BUSY:
                    raise
                self.poll_state()
                if self.flags & Flags.HOMING:
                    break  # only the ACK was lost
                if self.flags & Flags.ARMED or now() > deadline:
                    raise  # otherwise its brake acts, after STOP
        state = self._connection.state_since_question()
        renewed_us = (before or state).time_us
        while True:
            watch(state)
            if state.fault:
                raise fault_error(state.fault)
            if self.restarts > restarts:
                raise LinkError(RESTARTED)
            if self.flags & Flags.HOMED and not self.flags & Flags.HOMING:
                self.info()  # the limits are now those of the span that was measured
                return self.get_state()
            if not self.flags & (Flags.HOMED | Flags.HOMING):
                raise LinkError(
                    f"the cart on {self.port} ended homing, as no frame of this computer reached it for half "
                    "a second: check its cable, end what keeps this computer busy"
                )
            if now() > deadline:
                self.stop()
                raise PlantError(
                    f"homing was not done after {timeout:g} s: clear the track, let the pole hang, or give a "
                    "longer plant.home_timeout for a long track"
                )
            if microseconds_between(renewed_us, state.time_us) >= LEASE_RENEWAL_US:
                self._connection.link.send(Hello())
                renewed_us = state.time_us
            state = self._connection.current_state()

    def set_motor(self, value: int) -> int:
        """Send a motor value; return the value sent.

        That is `value` within the cart's limits, or 0 if it answers a state so old that the cart would refuse
        it. Raises LinkError if that state is older than `longest_suspension`.
        """
        connection = self._connection
        limit = max(0, self.information.motor_limit)  # 0 stays 0 for any limit in INFO
        sent = max(-limit, min(limit, int(value)))
        if sent and self._is_late():
            sent = 0
        connection.send_motor(sent)
        return sent

    def took_motor(self, state: State) -> bool:
        """Return True if the newest motor value was the last frame that the cart had taken before `state`."""
        return self._connection.took_motor(state)

    def get_state(self) -> State:
        """Wait for the newest state that was measured after the cart took the last frame sent.

        A state with a latched fault is returned, not raised. Raises RefusedError or FaultError if the cart
        refused the last motor value, LinkError if no state comes within `settings.timeout`.
        """
        if self._connection.notice_backlog():
            self._connection.link.send(Hello())  # a state that acknowledges it is newer than the backlog
        return self._connection.current_state()

    def poll_state(self) -> State:
        """Send HELLO and wait for a state. A lockstep cart advances only when it receives a frame."""
        self._connection.link.send(Hello())
        return self.get_state()

    def follow_policy(self) -> State:
        """Send HELLO, which lets the policy on the board drive on, and wait for a state.

        Raises LinkError, before it sends anything, if the last state is older than `longest_suspension`.
        """
        self.check_suspension(self._unanswered_for())
        return self.poll_state()

    @property
    def longest_suspension(self) -> float:
        """The time in s after which, without an answer of this computer, the link counts as lost."""
        return min(self.settings.timeout, LONGEST_SUSPENSION)

    @contextmanager
    def unmeasured(self) -> Iterator[None]:
        """Count neither latencies nor late ticks within the `with`: the host moves the cart, not a policy."""
        self._tracker.measuring = False
        try:
            yield
        finally:
            self._tracker.measuring = True

    def _arm(self, message: Start | StartPolicy) -> None:
        check_rig(self.information, self.flags, self.hardware)
        check_limits(self.information, self.hardware)
        self._check_round_trip()
        self._connection.arm(message)

    def _check_round_trip(self) -> None:
        """Raise LinkError if the link takes over a period. On a lockstep emulator no time passes.

        A cart that is not known to have its own clock gets another chance to show it, once a connection: its
        states may have failed to come while `open` listened.
        """
        if not self._looked_again:
            self._connection.learn_clock()
            self._looked_again = True
        period = self.information.period_us * 1e-6
        if self.is_lockstep:
            return
        for _ in range(SLOW_LINK_ATTEMPTS):
            trip = self._connection.round_trip()
            if trip <= period:
                return
        raise LinkError(
            f"the link to the cart on {self.port} is too slow to drive it: the way there and back takes "
            f"{trip * 1e3:.0f} ms, over a period of {period * 1e3:g} ms; connect the cart by a cable without "
            "a network between, set an FTDI adapter's latency timer to 1 ms"
        )

    def _stop(self, within: float) -> None:
        """Set the motor to 0 and disarm; wait `within` s at most for the answer."""
        self._stop_unanswered = True
        self._connection.request(Stop(), Ack, before=(SetMotor(0),), within=within)
        self._stop_unanswered = False

    def _is_late(self) -> bool:
        """Return True if the cart would refuse an answer to the newest state.

        Raises LinkError if the state is older than `longest_suspension`.
        """
        waited = self._unanswered_for()
        self.check_suspension(waited)
        return waited > WATCHDOG_PERIODS * self.information.period_us * 1e-6

    def _unanswered_for(self) -> float:
        """Return the age in s of the state that the next motor value answers; 0 on a lockstep emulator."""
        tracker = self._tracker
        return now() - tracker.answered_at if tracker.has_handed_out and tracker.ticks_alone else 0.0

    def check_suspension(self, seconds: float) -> None:
        """Raise LinkError if this computer did not answer the cart for too long."""
        if seconds > self.longest_suspension:
            raise LinkError(
                f"this computer did not answer the cart on {self.port} for {seconds:.1f} s, or heard nothing "
                "of it: end what keeps it busy, do not suspend a command that drives, check the cable"
            )

    def _note(self, information: Info) -> Info:
        self._information = information
        self._tracker.period_us = information.period_us
        return information

    @property
    def _connection(self) -> Connection:
        if self._open_connection is None:
            raise LinkError(f"the port {self.port} is not open: use `with SerialCart(...) as cart`")
        return self._open_connection

    def _abandon(self) -> None:
        """`close` without waiting for an answer: the device may not be a cart."""
        connection = self._connection
        try:
            with suppress(LinkError):
                connection.link.send(SetMotor(0), Stop())
        finally:
            self._disconnect(connection)

    def _disconnect(self, connection: Connection) -> None:
        self._open_connection = None
        self._tracker.disconnect()
        connection.link.close()
