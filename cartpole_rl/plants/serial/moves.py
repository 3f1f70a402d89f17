"""An armed cart on a wire that is moved a little at a time: what the preflight and the re-centring share."""

import math
from dataclasses import dataclass

from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError, fault_error
from cartpole_rl.wire import State

GENTLE_MOTOR = 199  # motor value; from 200 on the cart watches for stalls
REST_SECONDS = 0.3
REST_COUNTS = 2  # of the cart
LONGEST_REST = 10.0  # s
SWING_SECONDS = 1.5  # a whole swing of the large pole takes 1.3 s


@dataclass
class ArmedCart:
    """An armed cart. Every move raises FaultError when it latches a fault. Times by the cart's clock."""

    cart: SerialCart

    def arm(self) -> State:
        """Arm the motor, at rest."""
        self.cart.start()
        return self.seen(self.cart.get_state())

    def drive(self, motor: int) -> State:
        """One period under a motor value; the state at its end."""
        self.cart.set_motor(motor)
        return self.seen(self.cart.get_state())

    def rest(self) -> State:
        """Motor 0 until the cart stands. Raises NotReadyError if it never does."""
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
        """Motor 0 until the pole swings by `swing` counts or less, peak to peak; no longer than `patience` s.

        The states, and the swing that is left. A pole with little friction takes minutes to be still.
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
        """Control periods in a time."""
        return math.ceil(seconds / self.period)

    def seen(self, state: State) -> State:
        """Raise what is wrong with a state, or return it."""
        if state.fault:
            raise fault_error(state.fault)
        return state


def metres(counts: int) -> float:
    """Cart counts in m."""
    return counts * CART_METRES_PER_COUNT


def spread(counts: list[int]) -> int:
    """Largest less smallest count."""
    return max(counts) - min(counts)
