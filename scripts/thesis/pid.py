"""PID, which the thesis cites: `run=pid:balance observation=raw actions=nine_levels` of cartpole-evaluate.

Two loops: PD on the cart's position gives the angle to aim at, PID on the angle the force. Nothing of the
cart is known but its nominal force curve. The gains were set by hand in simulation.
"""

import math

import torch
from torch import Tensor

FORCES = torch.arange(-4.0, 5.0)  # N, of conf/actions/nine_levels.yaml
POSITION, SPEED = 0.25, 0.25  # rad per m and per m/s: how far the pole is to lean to the middle
PROPORTIONAL, INTEGRAL, DERIVATIVE = 50.0, 20.0, 6.0  # N per rad, per rad s, per rad/s
PERIOD = 0.02  # s
KEPT = 0.99  # of the integral in each period: an episode hardly knows of the one before
FALLEN = math.radians(12)  # beyond it nothing is integrated


class Pid:
    """The controller of N carts."""

    def __init__(self) -> None:
        self.integral = torch.zeros(1)  # rad s, [N]

    def __call__(self, observation: Tensor) -> Tensor:
        """Return how near each force is to the wanted one, [N, 9], for observations [N, 4] of kind raw."""
        x, x_dot, theta, theta_dot = observation.unbind(-1)
        error = theta + POSITION * x + SPEED * x_dot
        if len(self.integral) != len(error):
            self.integral = torch.zeros_like(error)
        stands = theta.abs() < FALLEN
        self.integral = stands * (KEPT * self.integral + PERIOD * error)
        force = PROPORTIONAL * error + INTEGRAL * self.integral + DERIVATIVE * theta_dot
        return -(force.unsqueeze(-1) - FORCES).abs()


balance = Pid()
