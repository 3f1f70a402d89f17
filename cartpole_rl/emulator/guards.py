"""What the firmware watches while the motor may move: a stalled cart and encoders that cannot be right."""

STALL_MOTOR = 200  # motor values from here on move any healthy cart
STALL_SECONDS = 0.5
STALL_COUNTS = 44  # 1 mm
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
