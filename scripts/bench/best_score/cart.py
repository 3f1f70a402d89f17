"""The nominal cart of a config, stepped for many states at once, with its true state and its score."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.envs.build import randomizer
from cartpole_rl.physics.actuator import static_force
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.tasks.features import (
    Measured,
    measured_position,
    measured_velocity,
)
from cartpole_rl.tasks.rewards import BONUS, score
from cartpole_rl.workflows.config import TrainConfig

MOST = 1 + 2 * BONUS  # points of a step, standing still in the middle
LOST = 1e9  # points: the loss of leaving the track, more than any score
ASYMMETRIES = ("track_tilt", "cart_coulomb_asymmetry", "force_asymmetry", "angle_offset")


class Nodes(NamedTuple):
    """N states of a search, with everything on which the next step and its score depend."""

    state: State  # true, [N] each
    force: Tensor  # [N] N, behind the actuator's lag
    motors: Tensor  # [D, N] delayed motor values, newest first
    counts: Tensor  # [2, N] encoder counts
    points: Tensor  # [N] score so far

    def at(self, rows: Tensor) -> "Nodes":
        """Return the nodes `rows`, which may repeat."""
        state = State(*(value[rows] for value in self.state))
        return Nodes(state, self.force[rows], self.motors[:, rows], self.counts[:, rows], self.points[rows])


class KnownCart:
    """The nominal cart of a config."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.randomizer = randomizer(config)
        self.models = config.models(config.plant)
        self.motors = torch.tensor(config.actions.motors, dtype=torch.float32)
        self.forces = static_force(self.motors, self.carts(len(self.motors)), self.models.actuator)
        self.commands = 1 + max(1, math.ceil(self.randomizer.longest_delay() / config.control_period - 1e-9))
        self.one = self.carts(1)
        self.reach = float(self.one.track_half_length)
        stiffness = self.one.first_moment * GRAVITY / self.one.pivot_inertia
        self.growth = float(stiffness.sqrt())  # 1/s, growth rate of the angle of a falling pole
        self._carts = self.one

    @property
    def steps(self) -> int:
        """Control periods in an episode."""
        return self.config.task.time_limit

    @property
    def symmetric(self) -> bool:
        """Whether left and right are alike, so that a mirrored start has the same best score."""
        motors = self.config.actions.motors
        mirrored = sorted(motors) == sorted(-motor for motor in motors)
        same_dead_band = bool(self.one.deadband_left == self.one.deadband_right)
        return (
            mirrored and same_dead_band and all(float(getattr(self.one, name)) == 0 for name in ASYMMETRIES)
        )

    def carts(self, count: int) -> CartParameters:
        """Return `count` nominal carts."""
        return CartParameters.from_table(self.randomizer.nominal.unsqueeze(1).repeat(1, count))

    def hanging(self, position: float) -> Nodes:
        """Return one node: at rest at `position` m, the pole hanging."""
        state = hanging(position)
        zero = torch.zeros(1)
        return Nodes(state, zero, torch.zeros(self.commands, 1), self.encoders(state, self.one), zero)

    def step(self, nodes: Nodes, action: Tensor) -> tuple[Nodes, Tensor, Tensor]:
        """Take actions [N]; return (nodes a period later, points [N], which are on the track [N])."""
        period, count = self.config.control_period, len(action)
        if len(self._carts) != count:
            self._carts = self.carts(count)
        cart = self._carts
        motors = torch.cat((self.motors[action].unsqueeze(0), nodes.motors[:-1]))
        drive = Drive(nodes.force, motors.unbind(0))
        substeps = self.config.plant.substeps
        state, drive = run_period(nodes.state, drive, cart.latency, cart, self.models, period, substeps)
        counts = self.encoders(state, cart)
        x, theta = measured_position(counts)
        x_dot, theta_dot = measured_velocity(counts, nodes.counts, torch.full((count,), period))
        points = score(Measured(x, x_dot, theta, theta_dot), self.config.task.x_max)
        on_track = state.x.abs() <= cart.track_half_length
        return Nodes(state, drive.force, motors, counts, nodes.points + points), points, on_track

    def run(self, nodes: Nodes, actions: Sequence[int]) -> Nodes:
        """Return one node after a sequence of actions, which ends early if the cart leaves the track."""
        for action in actions:
            nodes, _, on_track = self.step(nodes, torch.tensor([action]))
            if not on_track:
                break
        return nodes

    @staticmethod
    def encoders(state: State, cart: CartParameters) -> Tensor:
        """Return counts [2, N] without noise."""
        angle = state.theta + cart.angle_offset
        return torch.stack((state.x / CART_METRES_PER_COUNT, angle / POLE_RADIANS_PER_COUNT)).round().long()


def hanging(position: float) -> State:
    """Return the true state of one cart at rest at `position` m with a hanging pole."""
    return State(torch.tensor([position]), torch.zeros(1), torch.full((1,), math.pi), torch.zeros(1))


def wrapped(theta: Tensor) -> Tensor:
    """Return angles in [-pi, pi)."""
    return torch.remainder(theta + math.pi, 2 * math.pi) - math.pi
