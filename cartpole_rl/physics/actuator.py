"""From motor value to force on the cart: a measured force curve, or plain newtons; a lag; a delay.

The force curve is the thesis's quadratic fit (figure 5.5), F = sign(u) max(0, a u^2 + b |u| + c), with a gain and a
dead-band per direction. Plain newtons are the thesis's eyeballed levels: 1, 2, 3, 4 N at 100, 150, 200, 250, exactly.
"""

from enum import StrEnum

import torch
from torch import Tensor

from cartpole_rl.physics.parameters import CartParameters

SHORTEST_TIME_CONSTANT = 1e-6  # s; below it the lag is none


class Actuator(StrEnum):
    """How a motor value becomes a force."""

    NEWTONS = "newtons"
    FORCE_CURVE = "force_curve"


def static_force(motor: Tensor, cart: CartParameters, model: Actuator) -> Tensor:
    """Force that a held motor value settles at, N, [N]. `motor`: [N], -255 to 255."""
    size = motor.abs()
    if model is Actuator.NEWTONS:
        return torch.sign(motor) * (0.02 * size - 1).clamp(min=0)
    force = (cart.force_quadratic * size * size + cart.force_linear * size + cart.force_offset).clamp(min=0)
    rightward = (size > cart.deadband_right) * (1 + cart.force_asymmetry)
    leftward = (size > cart.deadband_left).to(force.dtype)
    return torch.where(motor > 0, force * rightward, -force * leftward)


def in_force_share(
    latency: Tensor, age: int, start: float, step: float, period: float
) -> Tensor:
    """Share of [start, start + step] in which the command of `age` periods ago is the one in force, 0 to 1, [N].

    Times in s from the start of this period. A command takes effect `latency` after its period began and is
    replaced one period later by the next.
    """
    since = latency - age * period
    until = since + period if age > 0 else torch.full_like(latency, float("inf"))
    overlap = until.clamp(max=start + step) - since.clamp(min=start)
    return (overlap / step).clamp(0, 1)


def lagged_force(force: Tensor, target: Tensor, time_constant: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Exact first-order lag over one step: (mean force over the step, force at its end), N, [N] each."""
    ratio = time_constant.clamp(min=SHORTEST_TIME_CONSTANT) / step
    decay = torch.exp(-1 / ratio)
    gap = force - target
    return target + gap * ratio * (1 - decay), target + gap * decay
