"""The interface of a driver: how this computer reads and commands a cart whose firmware is not ours.

A driver does no more than its board. The rules that stop a cart, the zeros and the protocol are those of
`bridge.py`, which runs the driver in a process of its own. Choose your own class with
`plant=driver plant.driver=my_module:MyCart`; docs/my-cart.md shows one.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

from cartpole_rl.registry import Extension, Registry

if TYPE_CHECKING:
    from cartpole_rl.plants.settings import BoardSettings
    from cartpole_rl.rig.hardware import Encoders


CLOCK_WRAP = 2**32  # of micros() and millis()


def unwrapped(ticks: int, last: int) -> int:
    """Return the ticks of a clock of 32 bits without its wrap: those nearest to the `last` ones."""
    return last + (ticks - last + CLOCK_WRAP // 2) % CLOCK_WRAP - CLOCK_WRAP // 2


class Measurement(NamedTuple):
    """One measurement of a board. Counts grow to the right, from any zero."""

    cart: int  # counts
    pole: int  # counts; may wrap at a whole turn
    us: int | None = None  # when it was measured, by the board's clock, which may wrap at 2^32; None: unknown


class Driver(ABC):
    """Reads and commands one cart.

    Every method may raise LinkError or OSError: the cart is lost then, and is stopped. `send`, `stop` and
    `home` are called one at a time, also while `read` waits in another thread. They have to return at once:
    after 0.5 s in one of them the cart counts as lost, and `stop` is called in another thread.
    """

    def __init__(self, settings: "BoardSettings", encoders: "Encoders") -> None:
        """`encoders` are those of the cart's file. Opens nothing."""
        self.settings, self.encoders = settings, encoders
        self.bad = 0  # measurements that could not be read, such as damaged lines
        self.why_bad = ""  # the newest of them, in words

    @abstractmethod
    def open(self) -> None:
        """Connect to the board. Raises PortError or LinkError."""

    @abstractmethod
    def read(self, timeout: float) -> Measurement | None:
        """Wait at most `timeout` s for the next measurement. None if none came."""

    @abstractmethod
    def send(self, value: float) -> None:
        """Command the motor: motor value, m/s or m/s^2, as `settings.sends` says, times its scale."""

    def home(self) -> None:
        """Start the board's own homing, which moves its cart. Needed for plant.homing=board."""
        raise NotImplementedError

    def stop(self) -> None:
        """Stop the motor, at once and for good. Called often; must not wait."""
        self.send(0.0)

    @abstractmethod
    def close(self) -> None:
        """Give the port back."""


DRIVERS: Registry[Extension] = Registry("driver", __name__)
DRIVERS.add("text", "cartpole_rl.plants.drivers.text:TextDriver")
