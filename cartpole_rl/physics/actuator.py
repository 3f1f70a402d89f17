"""From motor value to force on the cart: a measured force curve, or plain newtons; a lag; a delay.

The force curve is the thesis's quadratic fit (figure 5.5), F = sign(u) max(0, a u^2 + b |u| + c), with an
asymmetry, and a dead-band per direction. Plain newtons are the thesis's eyeballed levels: 1, 2, 3, 4 N at
100, 150, 200, 250.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from cartpole_rl.physics.models import Actuator
from cartpole_rl.physics.parameters import CartParameters

SHORTEST_TIME_CONSTANT = 1e-12  # s; stands in for no lag at all


def static_force(motor: Tensor, cart: CartParameters, model: Actuator) -> Tensor:
    """Force that a held motor value settles at, N. `motor`: [N], -255 to 255."""
    size = motor.abs()
    if model is Actuator.NEWTONS:
        return torch.sign(motor) * (0.02 * size - 1).clamp(min=0)
    curve = ((cart.force_quadratic * size + cart.force_linear) * size + cart.force_offset).clamp(min=0)
    rightward = (motor > cart.deadband_right) * (1 + cart.force_asymmetry)
    leftward = -motor > cart.deadband_left
    return curve * (rightward - leftward.to(curve.dtype))


def mean_commands(held: Sequence[Tensor], latency: Tensor, period: float, substeps: int) -> list[Tensor]:
    """Mean over each step of a period of what the commands in force hold, [N] each.

    `held` is what each command settles at, [N] each, newest first, each next one a period older, the oldest
    in force for ever. A command takes effect `latency` s, [N], after its period began and is replaced a
    period later by the next.
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


def lagged_force(force: Tensor, target: Tensor, time_constant: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Exact first-order lag over one step: (mean force over the step, force at its end), N, [N] each."""
    ratio = time_constant.clamp(min=SHORTEST_TIME_CONSTANT) / step
    decay = torch.exp(-1 / ratio)
    gap = force - target
    return target + gap * ratio * (1 - decay), target + gap * decay
