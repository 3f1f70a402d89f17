"""An armed cart that is moved a little at a time: shared by the preflight and the re-centring."""

import math

from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError, fault_error
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT
from cartpole_rl.wire import State

GENTLE_MOTOR = 199  # motor value; from 200 on the cart watches for stalls
REST_SECONDS = 0.3
REST_COUNTS = 2  # of the cart
LONGEST_REST = 10.0  # s
SWING_SECONDS = 1.5  # a whole swing of the large pole takes 1.3 s


class ArmedCart:
    """An armed cart. Every move raises FaultError when it latches a fault. Times by the cart's clock."""

    def __init__(self, cart: SerialCart) -> None:
        self.cart = cart

    def arm(self) -> State:
        """Arm the motor, at rest."""
        self.cart.start()
        return self.check(self.cart.get_state())

    def drive(self, motor: int) -> State:
        """Apply a motor value for one period; return the state at its end."""
        self.cart.set_motor(motor)
        return self.check(self.cart.get_state())

    def rest(self) -> State:
        """Apply motor 0 until the cart is at rest. Raises NotReadyError if it never does."""
        states = [self.drive(0)]
        for _ in range(self.periods(LONGEST_REST)):
            states.append(self.drive(0))
            counts = [state.cart_counts for state in states[-self.periods(REST_SECONDS) - 1 :]]
            if len(counts) > self.periods(REST_SECONDS) and spread(counts) <= REST_COUNTS:
                return states[-1]
        raise NotReadyError(
            f"the cart does not come to rest within {LONGEST_REST:g} s with the motor at 0",
            "put the track level, check that the motor driver gives no voltage at 0",
        )

    def calm(self, swing: int, patience: float) -> tuple[list[State], int]:
        """Apply motor 0 until the pole swings by `swing` counts peak to peak or less, within `patience` s.

        Returns the states and the swing that is left. A pole with little friction swings for minutes.
        """
        states = [self.rest()]
        for _ in range(self.periods(max(patience, SWING_SECONDS))):
            states.append(self.drive(0))
            poles = [state.pole_counts for state in states[-self.periods(SWING_SECONDS) - 1 :]]
            if len(poles) > self.periods(SWING_SECONDS) and spread(poles) <= swing:
                break
        return states, spread(poles)

    @property
    def period(self) -> float:
        """Control period in s."""
        return self.cart.information.period_us * 1e-6

    def periods(self, seconds: float) -> int:
        """Return the number of control periods in a time, rounded up."""
        return math.ceil(seconds / self.period)

    def check(self, state: State) -> State:
        """Return the state. Raises FaultError if it has a latched fault."""
        if state.fault:
            raise fault_error(state.fault)
        return state


def metres(counts: int) -> float:
    """Return cart counts in m."""
    return counts * CART_METRES_PER_COUNT


def spread(counts: list[int]) -> int:
    """Return the largest minus the smallest count."""
    return max(counts) - min(counts)
