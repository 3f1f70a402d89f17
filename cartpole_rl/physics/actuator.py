"""The actuator: force curve (or plain newtons), lag and delay from motor value to force on the cart.

The force curve is the thesis's quadratic fit (figure 5.5), F = sign(u) max(0, a u^2 + b |u| + c), with an
asymmetry, and a dead-band per direction. Plain newtons are the thesis's estimated levels: 1, 2, 3, 4 N at
100, 150, 200, 250.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from cartpole_rl.physics.laws import Law, law_registry

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

# The formula gives the steady force, N, of a motor value of -255 to 255.
ACTUATORS = law_registry("actuator")
SHORTEST_TIME_CONSTANT = 1e-12  # s; stands in for no lag
LAG = "motor_time_constant"
CURVE = (
    "force_quadratic",
    "force_linear",
    "force_offset",
    "force_asymmetry",
    "deadband_left",
    "deadband_right",
    LAG,
)


@ACTUATORS.register("newtons")  # without lag, dead-band or asymmetry
def newtons(motor: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return the thesis's levels and the line through them, whatever the cart."""
    return motor.sign() * (0.02 * motor.abs() - 1).clamp(min=0)


@ACTUATORS.register("force_curve", reads=CURVE)
def force_curve(motor: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return the force of the cart's own curve."""
    size = motor.abs()
    curve = ((cart.force_quadratic * size + cart.force_linear) * size + cart.force_offset).clamp(min=0)
    rightward = (motor > cart.deadband_right) * (1 + cart.force_asymmetry)
    leftward = -motor > cart.deadband_left
    return curve * (rightward - leftward.to(curve.dtype))


def step_forces(
    force: "Tensor",
    motors: "Sequence[Tensor] | Tensor",
    latency: "Tensor",
    cart: "CartParameters",
    law: Law,
    period: float,
    substeps: int,
) -> "tuple[list[Tensor], Tensor]":
    """Return the mean force in each step of a control period, and the force at its end, N, [N] each.

    `force` N is the force at its start; `motors` are the motor values of this period and the ones before it,
    newest first; `latency` s, [N], holds for all of them.
    """
    held = [law(motor, cart) for motor in motors]
    targets = mean_commands(held, latency, period, substeps)
    if LAG not in law.reads:
        return targets, targets[-1]
    mean, end = lag_shares(cart.motor_time_constant, period / substeps)
    means = []
    for target in targets:
        gap = force - target
        means.append(target + gap * mean)
        force = target + gap * end
    return means, force


def mean_commands(
    held: "Sequence[Tensor]", latency: "Tensor", period: float, substeps: int
) -> "list[Tensor]":
    """Return for each step of a period the mean of the forces in effect, [N] each.

    `held` is the force that each command settles at, [N] each, newest first, one period older each,
    the oldest always in effect. A command takes effect `latency` s, [N], after its period began and is
    replaced one period later by the next.
    """
    onset = latency * (substeps / period)  # in steps
    means = []
    for step in range(substeps):
        mean = held[0]
        for age, (newer, older) in enumerate(pairwise(held)):
            share_of_older = (onset - (substeps * age + step)).clamp(0, 1)
            mean = mean + share_of_older * (older - newer)
        means.append(mean)
    return means


def lag_shares(time_constant: "Tensor", step: float) -> "tuple[Tensor, Tensor]":
    """Return the shares of its gap to the target that a lagged force keeps: mean over a step, at its end."""
    ratio = time_constant.clamp(min=SHORTEST_TIME_CONSTANT) / step
    decay = (-1 / ratio).exp()
    return ratio * (1 - decay), decay
