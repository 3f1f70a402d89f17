"""Fault detection while the motor may move: a stalled cart and implausible encoders."""

from cartpole_rl.emulator.encoders import CART_METRES, POLE_COUNTS

STALL_MOTOR = 200  # smallest motor value that moves any healthy cart
STALL_SECONDS = 0.5
STALL_COUNTS = round(0.001 / CART_METRES)
PUSH_SECONDS = 0.1  # of such a push one way, after which the count must have changed
SPEED_CHANGE = 0.2 / CART_METRES  # counts/s; 0.2 m/s turn any pole by several counts
FASTEST_CART = 5.0 / CART_METRES  # counts/s; 5 m/s is over twice what the motor can reach on this track
FASTEST_POLE = 16.0 * POLE_COUNTS  # counts/s; 16 turns a second is five times a fast swing


class StallWatch:
    """Detects a hard push one way for half a second that moves the cart by less than a millimetre."""

    def __init__(self) -> None:
        self._since = 0.0  # s of pushing since the anchor was set
        self._anchor: tuple[int, bool] | None = None  # count and direction at the start of this push

    def stalled(self, cart: int, motor: int, seconds: float) -> bool:
        """Return whether the cart stalls, after `seconds` under `motor` that ended at count `cart`."""
        if abs(motor) < STALL_MOTOR:
            self._anchor = None
        elif self._anchor is None or self._anchor[1] != (motor > 0) or self._moved(cart):
            self._anchor, self._since = (cart, motor > 0), 0.0
        else:
            self._since += seconds
        return self._anchor is not None and self._since >= STALL_SECONDS

    def _moved(self, cart: int) -> bool:
        return self._anchor is not None and abs(cart - self._anchor[0]) >= STALL_COUNTS


class JumpWatch:
    """Detects a count that changes faster than the cart or pole can move."""

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest  # counts/s
        self._last: int | None = None

    def jumped(self, count: int, seconds: float) -> bool:
        """Return whether this count is impossible `seconds` after the last one."""
        last, self._last = self._last, count
        return last is not None and abs(count - last) > self._fastest * seconds


class FrozenCartWatch:
    """Detects a cart count that does not change under a hard push one way and then the other.

    Under a push one way only, the cart itself may be held by a stop or an obstacle, which is a stall. An
    obstacle on one side lets the cart move the other way, by at least one count.
    """

    def __init__(self) -> None:
        self._count: int | None = None
        self._direction = 0  # of the present push: 1, -1, or 0 for none
        self._seconds = 0.0  # since it began
        self._pushed: set[int] = set()  # directions of long pushes since the count changed

    def frozen(self, cart: int, motor: int, seconds: float) -> bool:
        """Return whether the encoder is frozen, after `seconds` under `motor` that ended at count `cart`."""
        direction = 0 if abs(motor) < STALL_MOTOR else 1 if motor > 0 else -1
        self._seconds = self._seconds + seconds if direction == self._direction else 0.0
        self._direction = direction
        if cart != self._count:
            self._count, self._seconds, self._pushed = cart, 0.0, set()
        if direction and self._seconds >= PUSH_SECONDS:
            self._pushed.add(direction)
        return len(self._pushed) == 2


class FrozenPoleWatch:
    """Detects a pole count that does not change while the cart speeds up by 0.2 m/s and slows down again.

    Gravity can hold a pole still in an accelerating cart only at one angle for each acceleration, so never
    at the same angle during an opposite acceleration.
    """

    def __init__(self) -> None:
        self._pole: int | None = None
        self._cart: int | None = None
        self._lowest = self._highest = 0.0  # cart speed in counts/s since the pole's count changed
        self._rise = self._fall = 0.0  # largest increase and decrease of that speed

    def frozen(self, pole: int, cart: int, seconds: float) -> bool:
        """Return whether the pole's encoder is frozen, `seconds` after the last counts."""
        last, self._cart = self._cart, cart
        if last is None:
            return False
        speed = (cart - last) / seconds
        if pole != self._pole:
            self._pole, self._lowest, self._highest = pole, speed, speed
            self._rise = self._fall = 0.0
        self._lowest, self._highest = min(self._lowest, speed), max(self._highest, speed)
        self._rise = max(self._rise, speed - self._lowest)
        self._fall = max(self._fall, self._highest - speed)
        return min(self._rise, self._fall) >= SPEED_CHANGE
