"""The rules that stop a cart: faults while the motor may move, and the limits of the track.

Faults are a stalled cart and implausible encoders, looked for at the end of each period. The limits know the
cart's position and speed; they are looked at once a millisecond.

Beyond the soft limit an outward motor value gives 0. Where looks are rare, it also gives 0 if it would make
the cart too fast to be stopped from the next look on. A cart that runs outward too fast to stop before its
hard limit is braked with full motor inward:

    left - shake < speed * (lag + reaction) + speed^2 / (2 * braking)

`left` is the way to the hard limit and `lag` the age of the measured speed. A fast pole shakes the cart
harder than the motor can hold it, by up to `lever` to each side of the common centre of mass. The speed of
that centre counts here if it is higher than the cart's. `shake` is twice the lever for a pole that turns 1.6
times a second or faster.

The brake acts while the cart is armed and after that until it has stood for half a second: a cart that STOP,
the watchdog or a fault leaves at speed would roll into an end stop, and a swinging pole moves one that stands
for a moment. It never pushes a cart that stands or moves inward.

A frozen encoder shows a cart that stands; one with an open wire, one whose count changes to and fro by one.
While the count changes by no more, the cart's motion is estimated from its last speed and, while the pole
is slow, from hard pushes. After 20 mm or 100 counts of it, the larger, the cart is `lost`: its encoder is
frozen, or something holds it. A lost cart is braked for the time that its estimated speed needs, or until
its count changes by more. Friction can hold a cart against weaker pushes: they tell nothing.

All numbers but one are whole, so that ``firmware/src/cart_guards.c`` and ``cart_limits.c`` decide the same.
Periods are in microseconds.
"""

import math
from collections import deque
from collections.abc import Mapping

from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware

LEFT, RIGHT = 1, 2  # bits of end switches
SHORTEST_US, LONGEST_US = 5_000, 100_000  # control periods
STALL_US = 500_000
STALL_UM = 1000
PUSH_US = 100_000  # of such pushes one way, after which the count must have changed
SPEED_CHANGE = 200_000  # um/s, for a look
LOOK_US = 62_000_000  # over the counts of a turn: then such a change turns a pole of 1 m by two counts
FASTEST_CART = 5_000_000_000  # nm/s; 5 m/s: over twice the motor's reach
FASTEST_POLE = 16  # turns/s; five times a fast swing


def micrometres(metres: float) -> int:
    """Return the whole micrometres in which the firmware has a distance of the rig."""
    return round(1e6 * metres)


def nearest_count(um: int, hardware: Hardware) -> int:
    """Return the nearest whole count to a distance in um, like CART_COUNTS in C."""
    nanometres = hardware.cart_nanometres_per_count
    return (um * 1000 + nanometres // 2) // nanometres


class StallWatch:
    """Detects a hard push one way for half a second that moves the cart by less than a millimetre."""

    def __init__(self, hardware: Hardware) -> None:
        self._hard_push = hardware.hard_push
        self._moves = nearest_count(STALL_UM, hardware)
        self._since_us = 0  # of pushing since the anchor was set
        self._anchor: tuple[int, bool] | None = None  # count and direction at the start of this push

    def stalled(self, cart: int, motor: int, us: int) -> bool:
        """Return whether the cart stalls, after a period of `us` under `motor` that ended at count `cart`."""
        if abs(motor) < self._hard_push:
            self._anchor = None
        elif self._anchor is None or self._anchor[1] != (motor > 0) or self._moved(cart):
            self._anchor, self._since_us = (cart, motor > 0), 0
        else:
            self._since_us += us
        return self._anchor is not None and self._since_us >= STALL_US

    def _moved(self, cart: int) -> bool:
        return self._anchor is not None and abs(cart - self._anchor[0]) >= self._moves


def is_too_fast(moved: int, us: int, fastest: int) -> bool:
    """Return whether a count `moved` faster than `fastest` counts/s; one count may come from rounding."""
    return (abs(moved) - 1) * 1_000_000 > fastest * us


class JumpWatch:
    """Detects a count that changes faster than the cart or pole can move."""

    def __init__(self, fastest: int) -> None:
        self._fastest = fastest  # counts/s
        self._last: int | None = None

    def jumped(self, count: int, us: int) -> bool:
        """Return whether this count is impossible `us` after the last one."""
        last, self._last = self._last, count
        return last is not None and is_too_fast(count - last, us, self._fastest)


class FrozenCartWatch:
    """Detects a cart count that does not change under hard pushes in both directions.

    Under a push one way only, the cart itself may be held by a stop or an obstacle. An obstacle on one side
    lets the cart move the other way, by at least two counts: one means nothing, as an open wire lets the
    count of a moving cart change to and fro by one. A push counts only from the time at which 0.5 m/s^2
    would have moved the cart by three counts: a shorter one may move too little.
    """

    def __init__(self, hardware: Hardware) -> None:
        self._hard_push = hardware.hard_push
        self._count: int | None = None
        self._direction = 0  # of the present push: 1, -1, or 0 for none
        self._lasts_us = 0  # its length up to the newest count, at most twice PUSH_US
        self._square = 12_000 * hardware.cart_nanometres_per_count  # us^2, from which on a push counts
        self._pushed_us = {1: 0, -1: 0}  # in each direction since the count changed, at most PUSH_US

    def frozen(self, cart: int, motor: int, us: int) -> bool:
        """Return whether the encoder is frozen, after `us` under `motor` that ended at count `cart`."""
        direction = 0 if abs(motor) < self._hard_push else 1 if motor > 0 else -1
        before_us = self._lasts_us if direction == self._direction else 0
        self._direction, self._lasts_us = direction, min(2 * PUSH_US, before_us + us)
        if self._count is None or abs(cart - self._count) > 1:
            self._count, self._pushed_us = cart, {1: 0, -1: 0}
        elif direction != 0 and before_us**2 >= self._square:
            self._pushed_us[direction] = min(PUSH_US, self._pushed_us[direction] + us)
        return min(self._pushed_us.values()) >= PUSH_US


class FrozenPoleWatch:
    """Detects a pole count that does not change while the cart speeds up by 0.2 m/s and slows down again.

    Gravity can hold a pole still in an accelerating cart only at one angle for each acceleration, so never
    at the same angle during an opposite acceleration. The speed is the mean of a *look*, which is long enough
    for the change to turn the pole by two counts.
    """

    def __init__(self, hardware: Hardware) -> None:
        self._nanometres = hardware.cart_nanometres_per_count
        self._look_us = max(SHORTEST_US, LOOK_US // hardware.pole_counts_per_turn)
        self._change = max(SPEED_CHANGE, 4 * self._nanometres * 1000 // self._look_us)
        self._pole: int | None = None
        self._cart = 0  # its count when the present look began
        self._elapsed_us = 0  # of this look
        self._moved = False  # a look has ended since the pole's count changed
        self._lowest = self._highest = 0  # cart speed in um/s since then
        self._rise = self._fall = 0  # largest increase and decrease of that speed

    def frozen(self, pole: int, cart: int, us: int) -> bool:
        """Return whether the pole's encoder is frozen, `us` after the last counts."""
        if self._pole is None or abs(pole - self._pole) > 1:
            self._pole, self._cart, self._elapsed_us = pole, cart, 0
            self._moved, self._lowest, self._highest, self._rise, self._fall = False, 0, 0, 0, 0
            return False
        self._elapsed_us += us
        if self._elapsed_us < self._look_us:
            return False
        speed = (cart - self._cart) * self._nanometres * 1000 // self._elapsed_us
        self._cart, self._elapsed_us = cart, 0
        if not self._moved:
            self._moved, self._lowest, self._highest = True, speed, speed
        self._lowest, self._highest = min(self._lowest, speed), max(self._highest, speed)
        self._rise = max(self._rise, speed - self._lowest)
        self._fall = max(self._fall, self._highest - speed)
        return min(self._rise, self._fall) >= self._change


SAMPLE_US = 1000  # between two samples of the position
SAMPLES = 9  # whose first and last give the speed
REACTION_US = 10_000  # until the motor's force has changed its sign
RELEASE_US = 10_000  # the brake is released this much later than it would be applied: it does not rattle
REST = 10_000  # um/s; slower outward motion is not braked
JUMPED = FASTEST_CART // 1000  # um/s; no cart is faster: its count has jumped
FASTEST = 10_000_000  # um/s; a higher speed counts as this one
FAST_POLE = 16  # tenths of a turn a second; a higher speed shakes the cart no further
LEVER = 27_206  # um, of the medium pole on ip02: m_p l / (m_c + m_p)
LONGEST_ROLLING_US = 3_000_000  # after the cart was armed
RESTED_US = 500_000  # without motion, after which it rests
SLOW_POLE = 6  # tenths of a turn a second; a faster pole may hold the cart against its motor
PUSHED = 5_000_000  # um/s^2: a hard push speeds a common cart up so hard
SLOWED_US = 100_000  # time constant of the estimated speed without a hard push
LOST_NM, LOST_COUNTS = 20_000_000, 100  # the larger: estimated motion while the count stands
FASTEST_LOST = 2_500_000  # um/s; a higher estimate comes from a count that jumped


def lever_um(numbers: Mapping[str, float]) -> int:
    """Return the lever of `TrackLimits`, um, by the parameters of a cart and its pole."""
    felt = numbers["backdrivability"] * numbers["pole_mass"]  # a stepper's cart does not swing with its pole
    return round(1e6 * felt * numbers["pole_com"] / (numbers["cart_mass"] + felt))


class TrackLimits:
    """The limits of one cart. `blocked` and `brake` are directions: 1 right, -1 left, 0 none."""

    def __init__(
        self, hardware: Hardware, lever: int = LEVER, samples: int = SAMPLES, look_us: int = 0
    ) -> None:
        """`lever` is m_p l / (m_c + m_p) in um, with l from the pivot to the pole's centre of mass.

        The speed is that over so many `samples`: few where they are far apart. `look_us` is the time between
        two looks, 0 where they are 1 ms apart, which REACTION_US includes.
        """
        self.soft = nearest_count(micrometres(hardware.soft_limit), hardware)  # counts inside a stop
        self.hard = nearest_count(micrometres(hardware.hard_limit), hardware)  # counts inside a stop
        self._nanometres = hardware.cart_nanometres_per_count
        self._radians = hardware.encoders.radians
        self._turn = hardware.pole_counts_per_turn
        self._fast_pole = self._turn * FAST_POLE // 10  # counts/s
        self._slow_pole = self._turn * SLOW_POLE // 10  # counts/s
        self._hard_push = hardware.hard_push
        self._lost = max(LOST_NM, LOST_COUNTS * self._nanometres)
        self._braking = round(1e6 * hardware.braking)  # um/s^2
        self.blocked = 0  # direction in which motor values are held at 0
        self.brake = 0  # direction of the full motor value that brakes the cart
        self._lever, self._look_us = lever, look_us
        self._samples = samples
        self._fresh = 0  # of them, taken since the cart was armed
        self._us: deque[int] = deque(maxlen=samples)
        self._carts: deque[int] = deque(maxlen=samples)
        self._poles: deque[int] = deque(maxlen=samples)
        self._until_us = 0  # the brake acts until then
        self._moved_us = 0  # the cart was armed or moved then
        self._blind_us = 0  # the brake of a lost cart acts until then
        self._count: int | None = None  # of the cart, since which its motion is estimated
        self._looked_us = 0
        self._speed_um = self._way_nm = 0  # estimated speed, um/s, and motion since the count changed

    def sample(self, now_us: int, cart: int, pole: int) -> None:
        """Take a sample of the raw counts, unless the newest is younger than `SAMPLE_US`."""
        if not self._us or now_us - self._us[-1] >= SAMPLE_US:
            self._fresh = min(self._fresh + 1, self._samples)
            self._us.append(now_us)
            self._carts.append(cart)
            self._poles.append(pole)

    def cart_jumped(self) -> bool:
        """Return whether the cart's count changed faster than a cart can move, since `forget`."""
        return self._jumped(self._carts, FASTEST_CART // self._nanometres)

    def pole_jumped(self) -> bool:
        """Return whether the pole's count changed faster than a pole can turn, since `forget`."""
        return self._jumped(self._poles, FASTEST_POLE * self._turn)

    def _jumped(self, counts: deque[int], fastest: int) -> bool:
        if self._look_us or self._fresh < self._samples:  # of a few measurements, each period tells as much
            return False
        return is_too_fast(counts[-1] - counts[0], self._us[-1] - self._us[0], fastest)

    def forget(self) -> None:
        """Start the estimate anew: the cart is armed now, and a hand may have moved it before."""
        self._count, self._fresh = None, 0

    def lost(self, now_us: int, motor: int) -> bool:
        """Return whether the cart's count stands still although the cart must have moved.

        `motor` is the value in force since the last look.
        """
        us, self._looked_us = max(0, min(now_us - self._looked_us, SLOWED_US)), now_us
        if not self._stands:
            self._count = self._newest
            self._speed_um, self._way_nm = max(-FASTEST, min(FASTEST, self._cart_speed())), 0
            return False
        if abs(motor) >= self._hard_push and abs(self._speed(self._poles)) < self._slow_pole:
            self._speed_um += (PUSHED if motor > 0 else -PUSHED) * us // 1_000_000
        elif abs(self._speed_um) < REST:
            self._speed_um = 0
        else:
            self._speed_um -= self._speed_um * us // SLOWED_US
        self._way_nm += self._speed_um * us // 1000
        return abs(self._way_nm) >= self._lost

    def brake_blindly(self, now_us: int) -> None:
        """Brake a lost cart by its estimated speed, for 0.5 s at most. All limits were released before."""
        if abs(self._speed_um) <= FASTEST_LOST:
            self._blind_us = now_us + abs(self._speed_um) * 1_000_000 // PUSHED
            self.brake = -1 if self._speed_um > 0 else 1

    def apply(
        self,
        now_us: int,
        outward: int,
        pole: int,
        half_span: int,
        armed: bool,
        pressed: int = 0,
        motor: int = 0,
    ) -> None:
        """Decide for a cart `outward` counts right of the middle and a pole `pole` counts from upright.

        `motor` is the value that the host wants; it counts where looks are more than 1 ms apart.
        The stops are `half_span` counts from the middle. Towards an end whose switch is `pressed`, the cart
        counts as being at that end or beyond: a false press never makes the way longer.
        """
        if now_us < self._blind_us and self._stands:
            return
        self._blind_us = 0
        speed = self._cart_speed()
        if armed:
            self._until_us = now_us + LONGEST_ROLLING_US
        if armed or abs(speed) >= REST:
            self._moved_us = now_us
        elif now_us >= self._moved_us + RESTED_US:
            self._until_us = 0
        self.blocked = 0
        if armed and abs(outward) >= half_span - self.soft:
            self.blocked = 1 if outward > 0 else -1
        elif armed and motor and self._look_us and self._us:
            side, since_us = 1 if motor > 0 else -1, self._look_us + (self._us[-1] - self._us[0]) // 2
            push = 3 * self._braking * abs(motor) // (2 * LARGEST_MOTOR)  # um/s^2; `braking` is a third less
            reached = max(0, side * speed + push * since_us // 1_000_000)
            if self._passes(side, side * reached, outward, pole, half_span, pressed):
                self.blocked = side
        acts = now_us < self._until_us
        self.brake = self._brake(speed, outward, pole, half_span, pressed) if acts else 0

    def release(self) -> None:
        """End all limits: the cart homes, or its count is not to be trusted."""
        self.blocked = self.brake = self._until_us = self._blind_us = 0

    def _brake(self, speed: int, outward: int, pole: int, half_span: int, pressed: int) -> int:
        if not REST <= abs(speed) <= JUMPED:
            return 0
        direction = 1 if speed > 0 else -1
        return -direction if self._passes(direction, speed, outward, pole, half_span, pressed) else 0

    def _passes(
        self, direction: int, speed: int, outward: int, pole: int, half_span: int, pressed: int
    ) -> bool:
        """Return True if a cart of `speed` um/s passes the hard limit ahead, braked after the next look."""
        fast = self._fast_pole
        turning = max(-fast, min(fast, self._speed(self._poles)))  # counts/s
        swing = int(self._lever * (turning * self._radians) * math.cos(pole * self._radians))  # um/s
        size = min(FASTEST, max(abs(speed), direction * (speed + swing)))
        counts = direction * outward  # towards the end ahead
        if pressed & (RIGHT if direction > 0 else LEFT):
            counts = max(counts, half_span)
        left = (half_span - self.hard - counts) * self._nanometres // 1000  # um
        shake = 2 * self._lever * turning * turning // (fast * fast)
        lag_us = (self._us[-1] - self._us[0]) // 2 + REACTION_US + self._look_us
        if self.brake == -direction:
            lag_us += RELEASE_US
        needed = size * lag_us // 1_000_000 + size * size // (2 * self._braking)
        return left - shake < needed

    @property
    def _newest(self) -> int:
        return self._carts[-1] if self._carts else 0

    @property
    def _stands(self) -> bool:
        """True if the count is as before, within one: with an open wire a moving cart's changes by one."""
        return self._count is not None and abs(self._newest - self._count) <= 1

    def _cart_speed(self) -> int:
        """Return the cart's speed in um/s, rounded down."""
        return self._speed(self._carts) * self._nanometres // 1000

    def _speed(self, counts: deque[int]) -> int:
        """Return the speed over the samples, in counts/s, rounded down."""
        if len(counts) < 2:
            return 0
        return (counts[-1] - counts[0]) * 1_000_000 // (self._us[-1] - self._us[0])
