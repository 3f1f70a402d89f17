"""Homing: touch both ends, check the span, centre the cart, wait until the pole hangs still.

An end is a stop that holds the cart or, on a rig with end switches, the place where one is pressed. A side
without a switch is then not visited: it is one span from the other.

Homing works on raw encoder counts, one reading every 15 ms or more: in less, a coarse encoder tells no speed.
It needs only rough numbers of the cart (motor
curve, mass and friction in `Hardware`), as firmware does. Distances and times are whole numbers of counts,
nanometres and microseconds; the speed servo and the brake compute in SI units, positive to the right. A
procedure is a generator: it receives a `Reading`, yields the motor value until the next one, and returns its
result. The pole's zero is the middle of its last small swing. Waiting for a complete stop would not be more
accurate: friction in the bearing holds a stopped pole up to a count off the vertical.
"""

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass

from cartpole_rl.emulator.guards import LEFT, RIGHT, micrometres, nearest_count
from cartpole_rl.errors import CartPoleError
from cartpole_rl.rig.hardware import Hardware

SEARCH_SPEED = 0.08  # m/s, towards a stop
TRAVEL_SPEED = 0.2  # m/s, far from a stop whose position is known
TOUCH_ZONE = 60_000_000  # nm, distance from such a stop at which the slow search begins
SWITCH_ZONE = 120_000_000  # the same for a switch, which must not be overrun: the cart is slow before
ASTRAY = 20_000_000  # nm, a motion the wrong way that means a reversed motor or encoder
FAST = 6  # tenths of a turn a second of a pole that may push a driven cart: 3.8 rad/s
SIDES = {LEFT: "left", RIGHT: "right", LEFT | RIGHT: "left and right"}
RELEASED = 30_000  # um; so far inside the place where it is pressed, any switch is released
AGAINST_STOP = 400_000  # us under full push without motion that mean a stop
STANDS = 300_000  # nm, largest motion in that time, or one count
RUNS = 0.1  # m/s, from which a cart takes time to stop, unless something stops it at once
HARDEST_STOP = 5.0  # m/s^2, of friction, the pole and the motor
LONGEST_SEARCH = 30_000_000, 20  # us for one stop; at least so many for a um of the track
LONGEST_LEAVING = 5_000_000  # us to move off a switch, for which a second is usual
CENTRED = 1_000_000  # nm
CROSSES = 0.1  # m/s, up to which a cart that crosses the middle between two readings is centred
LONGEST_CENTRING = 20_000_000, 5  # the same for the way to the middle

WHOLE_SWING = 2_000_000  # us: one period of a rod of 1.5 m
STILL = 70  # hundredths of a degree, peak to peak
BRAKED = 260  # the same; no brake improves a smaller swing
LONGEST_BRAKING = 20_000_000  # us
PATIENCE = 20_000_000  # us, after which NEARLY_STILL is sufficient, for a pole with hardly any friction
NEARLY_STILL = 350  # hundredths of a degree, peak to peak
LONGEST_WAIT = 60_000_000  # us
SHORTEST_LOOK = 15_000  # us between two readings; with shorter periods, as many as reach it
LONGEST_WINDOW = WHOLE_SWING // SHORTEST_LOOK + 1  # counts

TUNED_MASS = 0.85  # kg of cart and pole, for which the next number and the servo's gains were chosen
NEGLIGIBLE = 0.02  # N, below which the motor stays off
GENTLE = 0.2  # m/s^2, an acceleration that leaves the pole nearly still


@dataclass(frozen=True)
class Reading:
    """Raw counts at a tick, and the microseconds since the last one."""

    cart: int
    pole: int
    us: int
    pressed: int = 0  # end switches
    pressed_at: int = 0  # cart count where one was newly pressed

    @property
    def seconds(self) -> float:
        """The time since the last tick, s."""
        return self.us / 1e6


@dataclass(frozen=True)
class Zeros:
    """The result of homing, in raw counts."""

    left_stop: int
    right_stop: int
    hanging: int

    @property
    def middle(self) -> int:
        """Cart count in the middle of the track."""
        return (self.left_stop + self.right_stop) // 2

    @property
    def half_span(self) -> int:
        """Counts from the middle to a stop."""
        return (self.right_stop - self.left_stop) // 2


class HomingError(CartPoleError):
    """An end was not found, the span was wrong, or the pole did not come to rest."""

    def __init__(self, text: str, switches: int = 0) -> None:
        """`switches` are those that are to blame."""
        super().__init__(text)
        self.switches = switches


class RoughMotor:
    """The motor value for a force in N, roughly: a line with an offset."""

    def __init__(self, hardware: Hardware) -> None:
        self._offset, self._per_newton = hardware.motor_offset, hardware.motor_per_newton
        self._most = hardware.gentle_force  # N, largest force of these motions
        self._negligible = NEGLIGIBLE * (hardware.moving_mass / TUNED_MASS)

    def value(self, force: float) -> int:
        """Return the motor value."""
        if abs(force) < self._negligible:
            return 0
        return int(math.copysign(self._offset + self._per_newton * min(abs(force), self._most), force))


class SpeedServo:
    """PI control of the cart's speed with rough friction compensation; the target changes gently."""

    PROPORTIONAL = 12.0  # N s/m
    INTEGRAL = 80.0  # N/m
    TUNED_FOR = 0.02  # s, the period for these gains; a longer one needs smaller gains

    def __init__(self, hardware: Hardware) -> None:
        heavier = hardware.moving_mass / TUNED_MASS
        self._proportional, self._integrating = self.PROPORTIONAL * heavier, self.INTEGRAL * heavier
        self._friction, self._most = hardware.moving_friction, hardware.gentle_force
        self._motor = RoughMotor(hardware)
        self._reference = 0.0  # m/s, follows the target at GENTLE
        self._integral = 0.0  # N

    def motor(self, target: float, speed: float, seconds: float) -> int:
        """Return the motor value for the next `seconds`; target and measured speed in m/s."""
        change = GENTLE * seconds
        self._reference += max(-change, min(change, target - self._reference))
        error = self._reference - speed
        share = min(1.0, self.TUNED_FOR / seconds)
        integral = self._integral + share * self._integrating * error * seconds
        self._integral = max(-self._most, min(self._most, integral))
        ahead = math.copysign(self._friction, self._reference) if self._reference else 0.0
        return self._motor.value(ahead + share * self._proportional * error + self._integral)


class SwingBrake:
    """Brakes the swing of a hanging pole: the cart follows the pole and is pulled back to the middle."""

    FOLLOW = 0.9  # m/s^2 of the cart for 1 rad/s of the pole
    RETURN = 3.0  # 1/s^2
    DAMPING = 2.0  # 1/s
    HARDEST = 2.5  # m/s^2
    LONG_TRACK = 800_000  # um from stop to stop; on a shorter track the cart follows by so much less
    STANDS = 0.002  # m/s, a speed up to which the cart counts as standing

    def __init__(self, hardware: Hardware) -> None:
        room = min(1.0, micrometres(hardware.track_span) / self.LONG_TRACK)
        self._follow, self._hardest = self.FOLLOW * room, self.HARDEST * room
        self._mass, self._friction = hardware.moving_mass, hardware.moving_friction
        self._motor = RoughMotor(hardware)

    def motor(self, x: float, x_dot: float, swing: float, swing_dot: float) -> int:
        """Return the motor value; x in m from the middle, swing in rad from hanging, signed as the angle."""
        acceleration = -self._follow * swing_dot * math.cos(swing) - self.RETURN * x - self.DAMPING * x_dot
        acceleration = max(-self._hardest, min(self._hardest, acceleration))
        moving = x_dot if abs(x_dot) > self.STANDS else acceleration
        return self._motor.value(self._mass * acceleration + math.copysign(self._friction, moving))


Procedure = Generator[int, Reading, Reading]


class Window:
    """The newest counts of one encoder, over a time of at least `length_us`.

    It holds as many counts as that time has of the shortest period so far.
    """

    def __init__(self, length_us: int) -> None:
        self._length_us = length_us
        self._shortest_us: int | None = None  # period so far
        self._counts: deque[int] = deque(maxlen=LONGEST_WINDOW)
        self.full = False

    def add(self, count: int, us: int) -> None:
        """Add a count, `us` after the last one."""
        self._counts.append(count)
        self._shortest_us = us if self._shortest_us is None else min(us, self._shortest_us)
        length = min(LONGEST_WINDOW, -(-self._length_us // self._shortest_us) + 1)
        self.full = len(self._counts) >= length
        while len(self._counts) > length:
            self._counts.popleft()

    @property
    def spread(self) -> float:
        """Largest less smallest count; infinite until the window is full."""
        return max(self._counts) - min(self._counts) if self.full else math.inf

    @property
    def centre(self) -> int:
        """Middle between the largest and the smallest count."""
        return round((max(self._counts) + min(self._counts)) / 2)


class HeldWatch:
    """Detects that a stop or something else holds a driven cart, or that its encoder is dead."""

    def __init__(self, hardware: Hardware) -> None:
        self._metres = hardware.encoders.metres
        self._stands = max(1, STANDS // hardware.cart_nanometres_per_count)  # counts
        self._fast = hardware.pole_counts_per_turn * FAST // 10  # counts/s
        self._full_push = RoughMotor(hardware).value(hardware.gentle_force)
        self._ran = 0.0  # m/s, when the cart last moved; 0 if the pole was fast
        self._stopped = False  # at the reading before, at once
        self.window = Window(AGAINST_STOP)

    def is_held(self, before: Reading, reading: Reading, direction: int, motor: int, travels: bool) -> bool:
        """Return whether the cart stands under a full push, or stopped at once where it `travels`.

        It then stands at the next reading, too: a board may send a count twice. A fast pole can stop a cart.
        """
        ran, fast = direction * self._ran, pole_speed(before, reading) > self._fast
        moved = reading.cart - before.cart
        way = (ran - HARDEST_STOP / 2 * reading.seconds) * reading.seconds  # m
        runs_on = travels and not fast and ran >= RUNS and way > (2 * self._stands + 1) * self._metres
        again, self._stopped = self._stopped, runs_on and abs(moved) <= self._stands
        if not self._stopped:
            self._ran = 0.0 if fast else moved * self._metres / reading.seconds
        self.window.add(reading.cart, reading.us)
        pushed = motor == direction * self._full_push and self.window.spread <= self._stands
        return (self._stopped and again) or pushed


class Homing:
    """The homing of one rig."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self._nanometres = hardware.cart_nanometres_per_count
        self._metres, self._turn = hardware.encoders
        self._radians = hardware.encoders.radians
        self._span_um = micrometres(hardware.track_span)
        self._longest_search, self._longest_centring = (
            max(shortest, self._span_um * us) for shortest, us in (LONGEST_SEARCH, LONGEST_CENTRING)
        )
        self._fast = self._turn * FAST // 10  # counts/s
        self._released = nearest_count(RELEASED, hardware)
        self._ends = {LEFT: 0, RIGHT: 0}  # raw counts; where homing began, until they are found
        self._touch_zone = SWITCH_ZONE if hardware.switches else TOUCH_ZONE

    def home(self) -> Generator[int, Reading, Zeros]:
        """Perform the whole homing. Raises HomingError.

        Nothing is taken from an earlier homing: its zeros may be why the cart is homed again.
        """
        reading = yield 0
        reading = yield from self._touch_ends(reading)
        left, right = self._ends.values()
        span, nominal = (right - left) * self._nanometres, self._span_um * 1000  # nm
        if abs(span - nominal) > nominal * 3 // 100:
            track = f"{self._hardware.track_span:g} m"
            raise HomingError(f"the ends are {span / 1e9:.3f} m apart, not {track}")
        return Zeros(left, right, (yield from self.settle((left + right) // 2, reading)))

    def settle(self, middle: int, reading: Reading) -> Generator[int, Reading, int]:
        """Let the cart stand in the middle, its pole hanging still; return the pole's count then."""
        reading = yield from self.centre(middle, reading)
        hanging, reading = yield from self.find_hanging(reading)
        reading = yield from self.brake_swing(middle, hanging, reading)
        reading = yield from self.centre(middle, reading)
        return (yield from self.wait_until_still(reading))

    def _touch_ends(self, reading: Reading) -> Procedure:
        """Find the ends that have a switch, or without any both stops."""
        self._ends = {LEFT: reading.cart, RIGHT: reading.cart}
        span, switches = nearest_count(self._span_um, self._hardware), self._hardware.switches
        if switches:
            reading = yield from self.leave_switch(reading)
        expected = None
        if switches != RIGHT:
            reading = yield from self.touch_end(LEFT, None, reading)
            expected = self._ends[LEFT] + span
        if switches != LEFT:
            reading = yield from self.touch_end(RIGHT, expected, reading)
        if switches == LEFT:
            self._ends[RIGHT] = self._ends[LEFT] + span
        if switches == RIGHT:
            self._ends[LEFT] = self._ends[RIGHT] - span
        return reading

    def leave_switch(self, reading: Reading) -> Procedure:
        """Move off the switch that is searched first, if the cart stands on it."""
        first = self._hardware.switches & LEFT or RIGHT
        return (yield from self.touch_stop(1 if first == LEFT else -1, None, reading, first, until=0))

    def touch_end(self, side: int, expected: int | None, reading: Reading) -> Procedure:
        """Move until the switch of a side is pressed, or without switches until a stop holds the cart."""
        direction, switch = -1 if side == LEFT else 1, self._hardware.switches & side
        reading = yield from self.touch_stop(direction, expected, reading, switch, until=switch)
        self._ends[side] = reading.pressed_at if switch else reading.cart
        return reading

    def _check_switches(self, reading: Reading) -> None:
        """Raise HomingError if a switch is pressed where it cannot be: with the other one, or far inside."""
        inside = LEFT * (reading.cart - self._ends[LEFT] > self._released)
        inside |= RIGHT * (self._ends[RIGHT] - reading.cart > self._released)
        suspects = reading.pressed & (inside if reading.pressed != LEFT | RIGHT else LEFT | RIGHT)
        if suspects:
            raise HomingError(f"end switch {SIDES[suspects]}: pressed where it cannot be", suspects)

    def _check_no_switch(self, reading: Reading) -> None:
        """Raise HomingError if a switch is pressed in the middle of the track."""
        if reading.pressed:
            raise HomingError(f"end switch {SIDES[reading.pressed]}: pressed in the middle", reading.pressed)

    def touch_stop(
        self, direction: int, expected: int | None, reading: Reading, switch: int = 0, until: int = 0
    ) -> Procedure:
        """Move until a stop holds the cart, or until the state of a `switch` of the rig is `until`.

        `expected` is the end's raw count, or None if that is unknown.

        Raises HomingError if the cart moves the wrong way, faster than at the beginning, when it may have
        rolled, and faster than when a fast pole last pushed it.
        """
        servo, watch, elapsed, before = SpeedServo(self._hardware), HeldWatch(self._hardware), 0, reading
        start, rolled = reading.cart, 0.0
        longest = LONGEST_LEAVING if switch and not until else self._longest_search
        while elapsed < longest:
            self._check_switches(reading)
            if switch and reading.pressed & switch == until:
                return reading
            far = expected is not None and (expected - reading.cart) * self._nanometres > self._touch_zone
            speed = (reading.cart - before.cart) * self._metres / reading.seconds
            fast = pole_speed(before, reading) > self._fast
            if elapsed <= reading.us or fast:  # two readings give the first speed
                start, rolled = reading.cart, -direction * speed
            astray = (start - reading.cart) * direction * self._nanometres > ASTRAY
            if astray and -direction * speed > rolled:
                raise HomingError("the cart moves the wrong way: its motor or its encoder is reversed")
            motor = servo.motor(direction * (TRAVEL_SPEED if far else SEARCH_SPEED), speed, reading.seconds)
            held = watch.is_held(before, reading, direction, motor, far)
            before = reading
            if held:
                if switch:
                    raise HomingError(f"end switch {SIDES[switch]}: as before, and the cart stands", switch)
                return reading
            reading = yield motor
            elapsed += reading.us
        side = "right" if direction > 0 else "left"
        missed = f"end switch {SIDES[switch]}: as before" if switch else f"no end found on the {side}"
        raise HomingError(f"{missed} after {longest / 1e6:.0f} s", switch)

    def centre(self, middle: int, reading: Reading) -> Procedure:
        """Move gently to the middle and switch the motor off."""
        servo, watch, elapsed, before = SpeedServo(self._hardware), HeldWatch(self._hardware), 0, reading
        start = reading.cart
        while elapsed < self._longest_centring:
            self._check_switches(reading)
            away, past = middle - reading.cart, middle - before.cart
            speed = (reading.cart - before.cart) * self._metres / reading.seconds
            crosses = (away < 0) != (past < 0) and abs(speed) <= CROSSES
            if crosses or abs(away) * self._nanometres < CENTRED:
                return reading
            if pole_speed(before, reading) > self._fast:
                start = reading.cart
            if (abs(away) - abs(middle - start)) * self._nanometres > ASTRAY:
                raise HomingError("the cart moves away from the middle")
            speed_here = away * self._metres  # m/s: it slows down over the last second
            target = max(-TRAVEL_SPEED, min(TRAVEL_SPEED, speed_here))
            motor = servo.motor(target, speed, reading.seconds)
            held = watch.is_held(before, reading, -1 if away < 0 else 1, motor, travels=True)
            before = reading
            if held:
                raise HomingError("the cart stands: something holds it, or its encoder is dead")
            reading = yield motor
            elapsed += reading.us
        raise HomingError(f"not in the middle after {self._longest_centring / 1e6:.0f} s")

    def find_hanging(self, reading: Reading) -> Generator[int, Reading, tuple[int, Reading]]:
        """Watch the pole for a whole swing with the motor off; return the count at which it was fastest."""
        hanging, fastest, elapsed = reading.pole, 0, 0  # fastest in counts/s
        self._check_no_switch(reading)
        while elapsed < WHOLE_SWING:
            before = reading
            reading = yield 0
            self._check_no_switch(reading)
            elapsed += reading.us
            speed = pole_speed(before, reading)
            if speed > fastest:
                hanging, fastest = (reading.pole + before.pole) // 2, speed
        return hanging, reading

    def brake_swing(self, middle: int, hanging: int, reading: Reading) -> Procedure:
        """Brake the pole's swing by moving the cart about the middle. Raises HomingError if that pumps it."""
        brake, window, elapsed, before = SwingBrake(self._hardware), Window(WHOLE_SWING), 0, reading
        widest = 0  # counts of the swing before the brake can have changed it much
        while elapsed < LONGEST_BRAKING:
            self._check_no_switch(reading)
            window.add(reading.pole, reading.us)
            if window.spread <= self._swing(BRAKED):
                return reading
            if window.full and elapsed < 2 * WHOLE_SWING:
                widest = max(widest, int(window.spread))
            if window.full and window.spread > widest + self._turn // 4:
                raise HomingError("the pole swings ever wider: its encoder is reversed")
            if window.spread < self._turn // 4:  # the middle of such a small swing is the hanging pole
                hanging = window.centre
            motor = brake.motor(
                (reading.cart - middle) * self._metres,
                (reading.cart - before.cart) * self._metres / reading.seconds,
                (reading.pole - hanging) * self._radians,
                (reading.pole - before.pole) * self._radians / reading.seconds,
            )
            before = reading
            reading = yield motor
            elapsed += reading.us
        return reading

    def wait_until_still(self, reading: Reading) -> Generator[int, Reading, int]:
        """Wait with the motor off until the pole's swing is small; return the count in its middle."""
        window, elapsed = Window(WHOLE_SWING), 0
        while elapsed < LONGEST_WAIT:
            self._check_no_switch(reading)
            window.add(reading.pole, reading.us)
            if window.spread <= self._swing(STILL if elapsed < PATIENCE else NEARLY_STILL):
                return window.centre
            reading = yield 0
            elapsed += reading.us
        raise HomingError(f"the pole still swings by {window.spread} counts after {LONGEST_WAIT / 1e6:.0f} s")

    def _swing(self, centidegrees: int) -> int:
        """Return an angle in counts, at least one."""
        return max(1, (centidegrees * self._turn + 18_000) // 36_000)


def pole_speed(before: Reading, reading: Reading) -> int:
    """Return the pole's speed between two readings, in counts/s."""
    return abs(reading.pole - before.pole) * 1_000_000 // reading.us
