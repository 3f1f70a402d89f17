"""Knocks: a hand tips the pole over once it stands, as in the thesis's figure 6.10b."""

import math

import torch

from cartpole_rl.plants.specs import Plant
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

STANDS = 2.0  # s within 5 degrees of upright, after which the pole is knocked


class Knocks:
    """One knock per episode for each simulated cart: `speed` rad/s more, to the right and left in turn.

    Call it in each period, before the step.
    """

    def __init__(self, plant: Plant, speed: float) -> None:
        self._plant = plant
        self._speeds = speed * torch.tensor([1.0, -1.0]).repeat(1 + plant.carts // 2)[: plant.carts]
        self._patience = round(STANDS / plant.period)
        self.reset()

    def reset(self) -> None:
        """Begin an episode on all carts."""
        self._standing = torch.zeros(self._plant.carts, dtype=torch.int64)  # periods
        self._knocked = torch.zeros(self._plant.carts, dtype=torch.bool)

    def __call__(self) -> None:
        """Knock the poles that have stood for STANDS and were not knocked in this episode."""
        state = self._plant.true_state
        upright = state.theta.cos() > math.cos(UPRIGHT_ANGLE)
        self._standing = torch.where(upright, self._standing + 1, 0)
        due = (self._standing >= self._patience) & ~self._knocked
        if due.any():
            self._plant.place(state._replace(theta_dot=state.theta_dot + self._speeds * due))
            self._knocked |= due
