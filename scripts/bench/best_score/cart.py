"""The nominal cart of a config, stepped for many states at once, with its true state and its score."""

import math
from collections.abc import Sequence
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.compilation import Compiled
from cartpole_rl.envs.build import randomizer
from cartpole_rl.physics.dynamics import State
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.plants.simulated import Carts, Inputs, Period, commands_under_way, encoder_counts, run_carts
from cartpole_rl.rig.hardware import Encoders
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.tasks.features import Measured, measured_position, measured_velocity
from cartpole_rl.tasks.rewards import BONUS, score, speed_periods
from cartpole_rl.workflows.config import TrainConfig

MOST = 1 + 2 * BONUS  # points of a step, standing still in the middle
COASTING = 0.3  # s; friction stops some carts sooner
LOST = 1e9  # points: the loss of leaving the track, more than any score
COMPILED_SIZES = (1000, 2700, 9000)  # carts in a batch


class Nodes(NamedTuple):
    """N states of a search, with everything on which the next step and its score depend."""

    motion: Tensor  # [4, N], the true state
    drive: Tensor  # [1 + D, N]: force N, then delayed motor values, newest first
    counts: Tensor  # [2, N] encoder counts
    speeds: Tensor  # [speed_periods - 1, N] rad/s of the pole, measured in the steps before, newest first
    points: Tensor  # [N] score so far

    @property
    def state(self) -> State:
        """The true state, [N] each."""
        return State(*self.motion)

    def at(self, rows: Tensor) -> "Nodes":
        """Return the nodes `rows`, which may repeat."""
        return Nodes(*(value[..., rows] for value in self))


class KnownCart:
    """The nominal cart of a config; `compiled` makes a search faster and needs a C++ compiler."""

    def __init__(self, config: TrainConfig, compiled: bool = False) -> None:
        self.config, self.compiled = config, compiled
        self.task = config.task.at(config.control_period)
        self.speed_periods = speed_periods(config.control_period, self.encoders)
        self.randomizer = randomizer(config)
        self.models = config.models(config.plant)
        self.motors = torch.tensor(config.actions.motors)
        carts = CartParameters(self.table(len(self.motors)))
        self.forces = self.models.actuator(self.motors.float(), carts)
        self.commands = commands_under_way(self.randomizer.longest_delay(), config.control_period)
        self.one = CartParameters(self.table(1))
        self.reach = float(self.one.track_half_length)
        stiffness = self.one.first_moment * GRAVITY / self.one.pivot_inertia
        self.growth = float(stiffness.sqrt())  # 1/s, growth rate of the angle of a falling pole
        stopping = float(self.one.driven_mass / self.one.cart_viscous.clamp(min=1e-6))
        self.coasting = min(COASTING, stopping)  # s at its speed, for which a cart runs on

    def periods(self, seconds: float) -> int:
        """Return the control periods in `seconds`, at least one."""
        return max(1, round(seconds / self.config.control_period))

    @property
    def steps(self) -> int:
        """Control periods in an episode."""
        return self.task.periods

    @property
    def symmetric(self) -> bool:
        """True if left and right are symmetric, so that a mirrored start has the same best score."""
        motors = self.config.actions.motors
        mirrored = sorted(motors) == sorted(-motor for motor in motors)
        same_dead_band = bool(self.one.deadband_left == self.one.deadband_right)
        asymmetries = [getattr(self.one, each.name) for each in PARAMETERS.values() if each.mirrored]
        return mirrored and same_dead_band and not any(map(bool, asymmetries))

    @property
    def encoders(self) -> Encoders:
        """The scales of the cart's encoders."""
        return self.config.hardware.encoders

    def table(self, count: int) -> Tensor:
        """Return the parameters of `count` nominal carts, [P, count]."""
        return self.randomizer.nominal.unsqueeze(1).repeat(1, count)

    def hanging(self, position: float) -> Nodes:
        """Return one node: at rest at `position` m, the pole hanging."""
        state = hanging(position)
        counts = encoder_counts(state, self.one, torch.zeros(3, 1), self.encoders)
        drive, speeds = torch.zeros(1 + self.commands, 1), torch.zeros(self.speed_periods - 1, 1)
        return Nodes(torch.stack(state), drive, counts, speeds, torch.zeros(1))

    def step(self, nodes: Nodes, action: Tensor) -> tuple[Nodes, Tensor, Tensor]:
        """Take actions [N]; return (nodes a period later, points [N], which are on the track [N])."""
        period, count = self.config.control_period, len(action)
        carts = Carts(self.table(count), nodes.motion, nodes.drive)
        inputs = Inputs(self.motors[action].unsqueeze(0), torch.zeros(3, count))
        after = self._run(carts, inputs)
        x, theta = measured_position(after.counts, self.encoders)
        passed = torch.full((count,), period)
        x_dot, theta_dot = measured_velocity(after.counts, nodes.counts, passed, self.encoders)
        speeds = torch.cat((theta_dot.unsqueeze(0), nodes.speeds))
        points = score(Measured(x, x_dot, theta, speeds.mean(0)), self.task.x_max)
        following = Nodes(after.motion, after.drive, after.counts, speeds[:-1], nodes.points + points)
        return following, points, ~after.off_track[0]

    def _run(self, carts: Carts, inputs: Inputs) -> Period:
        """Run the carts for a period; many carts run compiled, in batches of few sizes, if it is `compiled`.

        One cart never does: it must move as it does in the environment, to the bit.
        """
        count, period, substeps = carts.table.shape[1], self.config.control_period, self.config.plant.substeps
        size = next((size for size in COMPILED_SIZES if size >= count), 0)
        if not self.compiled or count == 1 or not size:
            return run_carts(
                carts,
                inputs,
                models=self.models,
                period=period,
                substeps=substeps,
                encoders=self.encoders,
            )
        rows = torch.arange(size).clamp(max=count - 1)
        padded = (type(each)(*(value[:, rows] for value in each)) for each in (carts, inputs))
        after = compiled_run(self.models, period, substeps, self.encoders, (len(carts.drive), size))(*padded)
        return Period(*(value[:, :count] for value in after))

    def run(self, nodes: Nodes, actions: Sequence[int]) -> Nodes:
        """Return one node after a sequence of actions, which ends early if the cart leaves the track."""
        for action in actions:
            nodes, _, on_track = self.step(nodes, torch.tensor([action]))
            if not on_track:
                break
        return nodes


@cache
def compiled_run(
    models: Models, period: float, substeps: int, encoders: Encoders, drive: tuple[int, int]
) -> Compiled[Period]:
    """Return `run_carts` for a `drive` of that shape, compiled.

    It serves every cart with these models whose latency spans as many periods.
    """
    return Compiled(partial(run_carts, models=models, period=period, substeps=substeps, encoders=encoders))


def hanging(position: float) -> State:
    """Return the true state of one cart at rest at `position` m with a hanging pole."""
    return State(torch.tensor([position]), torch.zeros(1), torch.full((1,), math.pi), torch.zeros(1))


def wrapped(theta: Tensor) -> Tensor:
    """Return angles in [-pi, pi)."""
    return torch.remainder(theta + math.pi, 2 * math.pi) - math.pi
