"""Fault detection while the motor may move: a stalled cart and implausible encoders.

All numbers are whole, so that ``firmware/src/cart_guards.c`` decides the same. Periods are in microseconds.
"""

from cartpole_rl.emulator.encoders import CART_METRES, CART_NANOMETRES, POLE_COUNTS

HARD_PUSH = 200  # smallest motor value that moves any healthy cart
STALL_US = 500_000
STALL_COUNTS = round(0.001 / CART_METRES)
PUSH_US = 100_000  # of such pushes one way, after which the count must have changed
SPEED_CHANGE = 200_000  # um/s; 0.2 m/s turn any pole by several counts
FASTEST_CART = 5_000_000_000 // CART_NANOMETRES  # counts/s; 5 m/s: over twice what the motor can reach here
FASTEST_POLE = 16 * POLE_COUNTS  # counts/s; 16 turns a second is five times a fast swing


class StallWatch:
    """Detects a hard push one way for half a second that moves the cart by less than a millimetre."""

    def __init__(self) -> None:
        self._since_us = 0  # of pushing since the anchor was set
        self._anchor: tuple[int, bool] | None = None  # count and direction at the start of this push

    def stalled(self, cart: int, motor: int, us: int) -> bool:
        """Return whether the cart stalls, after a period of `us` under `motor` that ended at count `cart`."""
        if abs(motor) < HARD_PUSH:
            self._anchor = None
        elif self._anchor is None or self._anchor[1] != (motor > 0) or self._moved(cart):
            self._anchor, self._since_us = (cart, motor > 0), 0
        else:
            self._since_us += us
        return self._anchor is not None and self._since_us >= STALL_US

    def _moved(self, cart: int) -> bool:
        return self._anchor is not None and abs(cart - self._anchor[0]) >= STALL_COUNTS


class JumpWatch:
    """Detects a count that changes faster than the cart or pole can move."""

    def __init__(self, fastest: int) -> None:
        self._fastest = fastest  # counts/s
        self._last: int | None = None

    def jumped(self, count: int, us: int) -> bool:
        """Return whether this count is impossible `us` after the last one.

        One count may come from rounding.
        """
        last, self._last = self._last, count
        return last is not None and (abs(count - last) - 1) * 1_000_000 > self._fastest * us


class FrozenCartWatch:
    """Detects a cart count that does not change under hard pushes in both directions.

    Under a push one way only, the cart itself may be held by a stop or an obstacle. An
    obstacle on one side lets the cart move the other way, by at least one count. The period in which a push
    begins does not count: pushes that change their direction in each period may move nothing.
    """

    def __init__(self) -> None:
        self._count: int | None = None
        self._direction = 0  # of the present push: 1, -1, or 0 for none
        self._pushed_us = {1: 0, -1: 0}  # in each direction since the count changed, at most PUSH_US

    def frozen(self, cart: int, motor: int, us: int) -> bool:
        """Return whether the encoder is frozen, after `us` under `motor` that ended at count `cart`."""
        direction = 0 if abs(motor) < HARD_PUSH else 1 if motor > 0 else -1
        lasted, self._direction = direction != 0 and direction == self._direction, direction
        if cart != self._count:
            self._count, self._pushed_us = cart, {1: 0, -1: 0}
        elif lasted:
            self._pushed_us[direction] = min(PUSH_US, self._pushed_us[direction] + us)
        return min(self._pushed_us.values()) >= PUSH_US


class FrozenPoleWatch:
    """Detects a pole count that does not change while the cart speeds up by 0.2 m/s and slows down again.

    Gravity can hold a pole still in an accelerating cart only at one angle for each acceleration, so never
    at the same angle during an opposite acceleration.
    """

    def __init__(self) -> None:
        self._pole: int | None = None
        self._cart: int | None = None
        self._lowest = self._highest = 0  # cart speed in um/s since the pole's count changed
        self._rise = self._fall = 0  # largest increase and decrease of that speed

    def frozen(self, pole: int, cart: int, us: int) -> bool:
        """Return whether the pole's encoder is frozen, `us` after the last counts."""
        last, self._cart = self._cart, cart
        if last is None:
            return False
        speed = (cart - last) * CART_NANOMETRES * 1000 // us
        if pole != self._pole:
            self._pole, self._lowest, self._highest = pole, speed, speed
            self._rise = self._fall = 0
        self._lowest, self._highest = min(self._lowest, speed), max(self._highest, speed)
        self._rise = max(self._rise, speed - self._lowest)
        self._fall = max(self._fall, self._highest - speed)
        return min(self._rise, self._fall) >= SPEED_CHANGE
