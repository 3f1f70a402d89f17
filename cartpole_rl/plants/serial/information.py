"""Checks by a cart's INFO that it is the kind of cart that this package drives.

Positions, angles and forces are computed from constants: encoder counts per turn, metres per count, the range
of motor values. With a cart that has other constants every number would be wrong, so it is refused.
"""

from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT, HALF_SPAN, LARGEST_MOTOR, POLE_COUNTS_PER_TURN
from cartpole_rl.wire import Info

SPAN_TOLERANCE = 0.05  # share; homing accepts 3 %
SHORTEST_PERIOD_US, LONGEST_PERIOD_US = 5_000, 100_000  # docs/protocol.md, SET_PERIOD
NANOMETRES_PER_COUNT = round(CART_METRES_PER_COUNT * 1e9)


def check_scales(information: Info) -> None:
    """Raise NotReadyError if the cart's scales or its period are not the ones that this package uses."""
    constants = {
        "cart nm per count": (information.cart_nanometres_per_count, NANOMETRES_PER_COUNT),
        "pole counts per turn": (information.pole_counts_per_turn, POLE_COUNTS_PER_TURN),
        "motor limit": (information.motor_limit, LARGEST_MOTOR),
    }
    for name, (reported, expected) in constants.items():
        if reported != expected:
            raise NotReadyError(
                f"INFO says {name} {reported}, not {expected}", "correct the firmware's settings"
            )
    check_period(information)


def check_period(information: Info) -> None:
    """Raise NotReadyError if the cart's period is none that the protocol allows."""
    if not SHORTEST_PERIOD_US <= information.period_us <= LONGEST_PERIOD_US:
        raise NotReadyError(
            f"INFO says period {information.period_us} us, not {SHORTEST_PERIOD_US} to {LONGEST_PERIOD_US}",
            "correct the firmware's settings",
        )


def check_limits(information: Info) -> None:
    """Raise NotReadyError if the soft and the hard limit do not fit the track."""
    soft = information.soft_limit_counts * CART_METRES_PER_COUNT
    hard = information.hard_limit_counts * CART_METRES_PER_COUNT
    if not 0.5 * HALF_SPAN < soft < hard < (1 + SPAN_TOLERANCE) * HALF_SPAN:
        raise NotReadyError(
            f"INFO says soft limit {soft * 1e3:.0f} mm, hard limit {hard * 1e3:.0f} mm from the middle; the "
            f"soft one comes first, and both in the outer half of the {HALF_SPAN * 1e3:.0f} mm to a stop",
            "correct the firmware's limits",
        )
