"""The moves of the preflight, on a cart that may be wired wrongly."""

from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.centring import NOMINAL_DEADBAND, centre
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import GENTLE_MOTOR, ArmedCart, metres
from cartpole_rl.rig.hardware import cart_counts, pole_counts
from cartpole_rl.wire import Flags, State

FARTHEST = 0.08  # m from the middle: no check needs more
LEAST_SPEED = 0.03  # m/s of the way back to the middle; slower would take long and show nothing
NEAR = 0.004  # m from the middle: no check needs to start closer
RAMP_STEP = 1  # motor values per period
SMALL_SWING = pole_counts(3.5)  # peak to peak; pushes the cart like three motor values
SHORT_PATIENCE = 5.0  # s
MOVED = cart_counts(0.09e-3)  # more than a pole that swings can press into the gears' play
NO_MOTION = (  # the remedy for a cart whose count does not change
    "switch the motor's supply on, check the cables of the motor and of the cart's encoder, free the cart"
)


class Probe(ArmedCart):
    """An armed cart that is moved a little at a time, and what its moves have shown so far.

    Every move raises NotReadyError when the cart gets too far from the middle, and FaultError when it latches
    a fault. Positions in counts, times by the cart's clock.
    """

    def __init__(self, cart: SerialCart) -> None:
        super().__init__(cart)
        self.deadband: dict[int, int] = {}  # motor value that just moves it, to the RIGHT and to the LEFT
        self.farthest = 0  # counts from the middle
        self.limited = False  # the soft limit has held a motor value back

    def settle(self) -> State:
        """Apply motor 0 until the pole hardly swings, but not for long; return the last state."""
        return self.calm(SMALL_SWING, SHORT_PATIENCE)[0][-1]

    def ramp(self, side: int) -> tuple[int, State, State]:
        """Raise the motor value to one side until the cart moves.

        Returns the size of that value, and the states before and after the move. Raises NotReadyError if the
        cart never moves.
        """
        before = self.settle()
        for size in range(RAMP_STEP, GENTLE_MOTOR + 1, RAMP_STEP):
            after = self.drive(side * size)
            if abs(after.cart_counts - before.cart_counts) >= MOVED:
                return size, before, after
        raise NotReadyError(
            f"motor values up to {side * GENTLE_MOTOR:+d} do not move the cart's count", NO_MOTION
        )

    def centre(self) -> None:
        """Bring the cart to the middle and to rest. Needs the sign of the cart's count to be right.

        A dead-band that is not measured yet is taken from the other side. Raises NotReadyError if the cart
        does not get there.
        """
        other_side = {-side: motor for side, motor in self.deadband.items()}
        known = NOMINAL_DEADBAND | other_side | self.deadband
        self.rest()
        centre(self, known, NEAR, LEAST_SPEED)
        self.rest()

    def check(self, state: State) -> State:
        """Record the cart's position and return the state. Raises NotReadyError or FaultError."""
        self.farthest = max(self.farthest, abs(state.cart_counts))
        self.limited = self.limited or bool(self.cart.flags & Flags.SOFT_LIMIT)
        super().check(state)
        if metres(abs(state.cart_counts)) > FARTHEST:
            self.cart.stop()
            raise NotReadyError(
                f"the cart went {metres(state.cart_counts) * 1e3:+.0f} mm, further than any requested move",
                "put the track level, check the motor driver",
            )
        return state
