"""What the firmware watches while the motor may move: a stalled cart and encoders that cannot be right."""

STALL_MOTOR = 200  # motor values from here on move any healthy cart
STALL_SECONDS = 0.5
STALL_COUNTS = 44  # 1 mm
PUSH_SECONDS = 0.1  # of such a push one way, after which a count must have changed
SPEED_CHANGE = 0.2 / 22749e-9  # counts/s; 0.2 m/s of the cart turn any pole by several counts
FASTEST_CART = 5.0 / 22749e-9  # counts/s; 5 m/s is over twice what the motor can reach on this track
FASTEST_POLE = 16 * 4096.0  # counts/s; 16 turns a second is five times a fast swing


class StallWatch:
    """A hard push one way for half a second that moves the cart by less than a millimetre."""

    def __init__(self) -> None:
        self._since = 0.0  # s of pushing from the anchor
        self._anchor: tuple[int, bool] | None = None  # count and direction where this push began

    def stalled(self, cart: int, motor: int, seconds: float) -> bool:
        """Whether the cart stalls, after `seconds` under `motor` ended at a count."""
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
    """A count that changes faster than the cart or pole can move: a miscounting encoder."""

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest  # counts/s
        self._last: int | None = None

    def jumped(self, count: int, seconds: float) -> bool:
        """Whether this count cannot follow the last one, `seconds` ago."""
        last, self._last = self._last, count
        return last is not None and abs(count - last) > self._fastest * seconds


class FrozenCartWatch:
    """A cart count that does not change at all under a hard push one way and then the other.

    Pushed one way only, it may be the cart that stands, against a stop or something on the track; that is
    the stall watch's. What jams a cart one way lets it go the other way, by a count of 23 um at least.
    """

    def __init__(self) -> None:
        self._count: int | None = None
        self._direction = 0  # of the push that lasts: 1, -1, or 0 for none
        self._seconds = 0.0  # that it has lasted
        self._pushed: set[int] = set()  # directions of long pushes since the count changed

    def frozen(self, cart: int, motor: int, seconds: float) -> bool:
        """Whether the encoder is dead, after `seconds` under `motor` ended at a count."""
        direction = 0 if abs(motor) < STALL_MOTOR else 1 if motor > 0 else -1
        self._seconds = self._seconds + seconds if direction == self._direction else 0.0
        self._direction = direction
        if cart != self._count:
            self._count, self._seconds, self._pushed = cart, 0.0, set()
        if direction and self._seconds >= PUSH_SECONDS:
            self._pushed.add(direction)
        return len(self._pushed) == 2


class FrozenPoleWatch:
    """A pole count that does not change at all while the cart speeds up by 0.2 m/s and slows down again.

    Gravity can hold a pole still in a cart that accelerates, but only at one angle for one acceleration,
    never at the same angle for another one the other way.
    """

    def __init__(self) -> None:
        self._pole: int | None = None
        self._cart: int | None = None
        self._lowest = self._highest = 0.0  # counts/s of the cart since the pole's count changed
        self._rise = self._fall = 0.0  # largest changes of that speed, each way

    def frozen(self, pole: int, cart: int, seconds: float) -> bool:
        """Whether the pole's encoder is dead, `seconds` after the last counts."""
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
