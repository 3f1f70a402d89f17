"""N simulated carts as one plant: parameters and starts drawn for each episode, physics, encoders.

The true state stays inside; the frames hold what a cart reports over its serial port. One control period is
a pure function, `run_carts`: a motor value in, encoder counts out. Its random numbers are drawn in advance,
so that it can be compiled. Its tensors are [N] or [k, N], the transpose of the tensors in the tensordict:
compiled code then runs along the carts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.arithmetic.writer import Scalar, plain
from cartpole_rl.compilation import Compiled
from cartpole_rl.physics.dynamics import Drive, MakeAddition, State, run_period
from cartpole_rl.physics.models import Models, check_laws
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.randomization.randomizer import START_SHARE, Draws, draw_start, within_track
from cartpole_rl.rig.hardware import Encoders, Hardware
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.tasks.episode import Origin
from cartpole_rl.tasks.settings import StartSettings

if TYPE_CHECKING:
    from cartpole_rl.envs.settings import CartPoleSettings

LARGEST_COUNT = 2**30  # STATE's counts are 32-bit numbers
DRAWN_AT_ONCE = 1024  # episodes; drawing a few takes about as long


class Carts(NamedTuple):
    """The state before a period, in few tensors: each one costs time in every call."""

    table: Tensor  # [P, N], one row per parameter, for `CartParameters`
    motion: Tensor  # [4, N], the true `State`
    drive: Tensor  # [1 + D, N], the `Drive`: force, then motor values, newest first


class Inputs(NamedTuple):
    """The inputs of a period."""

    motor: Tensor  # [1, N] int64
    noise: Tensor  # [3, N]: of the latency, uniform in -1 to 1; of position and angle, standard normal


class Period(NamedTuple):
    """The results of a period."""

    motion: Tensor  # [4, N]
    drive: Tensor  # [1 + D, N]
    counts: Tensor  # [2, N] int64
    motor_applied: Tensor  # [1, N] int64
    off_track: Tensor  # [1, N] bool


def commands_under_way(delay: float, period: float) -> int:
    """Return how many motor values are under way at most with delays of up to `delay` s."""
    return 1 + max(1, math.ceil(delay / period - 1e-9))


def run_carts(
    carts: Carts,
    inputs: Inputs,
    *,
    models: Models,
    period: float,
    substeps: int,
    encoders: Encoders,
    addition: MakeAddition | None = None,
    in_effect: int | None = None,
) -> Period:
    """Run every cart for `period` s in `substeps` steps under a new motor value.

    `addition` and `in_effect` are those of `run_period`.
    """
    cart = CartParameters(carts.table)
    before = State(*carts.motion.unbind(0))
    force, *motors = carts.drive.unbind(0)
    drive = Drive(force, [inputs.motor[0].to(force.dtype), *motors[:-1]])
    latency = (cart.latency + inputs.noise[0] * cart.latency_jitter).clamp(min=0)
    state, drive = run_period(before, drive, latency, cart, models, period, substeps, addition, in_effect)
    return Period(
        torch.stack(state),
        torch.stack((drive.force, *drive.motors)),
        encoder_counts(state, cart, inputs.noise, encoders),
        motor_in_force(drive.motors[:in_effect], cart.latency, period),
        ~(state.x.abs() <= cart.track_half_length).unsqueeze(0),  # also if it is NaN
    )


def encoder_counts(state: State, cart: CartParameters, noise: Tensor, encoders: Encoders) -> Tensor:
    """Return counts [2, N] int64 of the true state, with the error of the zero and `noise` [3, N]."""
    x = state.x + noise[1] * cart.position_noise
    theta = state.theta + cart.angle_offset + noise[2] * cart.angle_noise
    counts = torch.stack((x / encoders.metres, theta / encoders.radians)).round()
    return counts.nan_to_num(0.0).clamp(-LARGEST_COUNT, LARGEST_COUNT).long()


def motor_in_force(motors: Sequence[Tensor], latency: Tensor, period: float) -> Tensor:
    """Return the motor value [1, N] int64 in force at a period's end, of `motors` [N] each, newest first."""
    applied = motors[0]
    for age in range(1, len(motors)):
        applied = torch.where(latency > age * period, motors[age], applied)
    return applied.unsqueeze(0).long()


class Starts(NamedTuple):
    """Starts of coming episodes, drawn in advance."""

    table: Tensor  # [P, M]
    motion: Tensor  # [4, M]
    counts: Tensor  # [2, M] int64, of the first frame


class SimulatedPlant(Plant):
    """N simulated carts.

    `period` s is one control period, integrated in `substeps` steps. Parameters and the start are new in each
    episode, for the rows that reset; `parameters` reads the values in force. A `compiled` plant and the
    hardware transform over it are several times faster, need a C++ compiler and take seconds to compile.
    """

    def __init__(
        self,
        carts: int,
        randomizer: Draws,
        start: StartSettings,
        models: Models,
        period: float = 0.02,
        substeps: int = 4,
        seed: int = 0,
        device: torch.device | str = "cpu",
        compiled: bool = False,
        hardware: Hardware | None = None,
    ) -> None:
        super().__init__(carts, device, hardware)
        self.compiled = compiled
        self.randomizer, self.start, self.models = randomizer, start, models
        self.period, self.substeps = period, substeps
        encoders = self.hardware.encoders
        run = partial(run_carts, models=models, period=period, substeps=substeps, encoders=encoders)
        self._run: Callable[[Carts, Inputs], Period] = Compiled(run) if compiled else run
        self._plain_run = run
        self._run_one: Scalar | None = None  # of a single cart
        self._generator = torch.Generator(device=self.device)
        self._noisy = any(
            randomizer.can_differ_from_zero(each.name) for each in PARAMETERS.values() if each.noise
        )
        self._no_noise = torch.zeros(3, carts, device=self.device)
        commands = commands_under_way(randomizer.longest_delay(), period)
        self._carts = Carts(
            randomizer.nominal.unsqueeze(1).repeat(1, carts),
            torch.zeros(4, carts, device=self.device),
            torch.zeros(1 + commands, carts, device=self.device),
        )
        self._cart = CartParameters(self._carts.table)  # its fields share the table's memory
        check_laws(models, CartParameters(randomizer.nominal.unsqueeze(1)))
        self.set_seed(seed)

    @property
    def parameters(self) -> CartParameters:
        """The parameters in force, [N]; they change in place when a row resets: clone them to keep them."""
        return self._cart

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Share the table's memory again, which a pickle does not keep."""
        self.__dict__.update(state, _cart=CartParameters(state["_carts"].table))

    @property
    def true_state(self) -> State:
        """The state that no encoder sees, [N] each."""
        return State(*self._carts.motion.unbind(0))

    @property
    def pole_length(self) -> Tensor:
        """m, [N]: 2 l of the pole that each cart carries."""
        return self.parameters.pole_length

    @property
    def track_half_length(self) -> Tensor:
        """m, [N]."""
        return self.parameters.track_half_length

    def place(self, state: State) -> None:
        """Put the carts into `state`; for tests, knocks and replay."""
        self._carts = self._carts._replace(motion=torch.stack(state).to(self._carts.motion))

    def origins(self) -> list[Origin]:
        """Return the present cart and true state of each row; after a reset, those at the episode's start."""
        names, states = CartParameters.names(), self._carts.motion.T.tolist()
        return [
            Origin(dict(zip(names, cart, strict=True)), dict(zip(State._fields, state, strict=True)))
            for cart, state in zip(self._carts.table.T.tolist(), states, strict=True)
        ]

    def start_from(self, state: Mapping[str, float]) -> None:
        """Start the next episode of every cart in this true state; `Origin` has the units."""
        table = self.randomizer.draw(self.carts, self._generator)
        column = torch.tensor([[state[name]] for name in State._fields], device=self.device)
        motion = column.repeat(1, self.carts)
        counts = self._first_counts(table, motion)
        self._coming = Starts(table, motion, counts)

    def replace_randomizer(self, randomizer: Draws) -> None:
        """Draw the next episodes from `randomizer`, whose delays are no longer than those of the first."""
        self.randomizer = randomizer
        self._coming = self._draw_starts(0)

    def snapshot(self) -> dict[str, Any]:
        """Return the whole state of the plant, for `restore`."""
        coming = {f"next_{name}": value.clone() for name, value in self._coming._asdict().items()}
        now = {name: value.clone() for name, value in self._carts._asdict().items()}
        return {**now, **coming, "generator": self._generator.get_state()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Return to `snapshot`; parameters that are newer than it are nominal."""

        def copied(name: str) -> Tensor:
            value = snapshot[name].to(self.device, copy=True)
            if "table" not in name:
                return value
            newer = self.randomizer.nominal[len(value) :].unsqueeze(1).repeat(1, value.shape[1])
            return torch.cat((value, newer))

        drive, rows = copied("drive"), len(self._carts.drive)
        # of a model with a shorter memory
        unknown = drive.new_zeros(max(0, rows - len(drive)), drive.shape[1])
        self._carts.table.copy_(copied("table"))
        self._carts = Carts(self._carts.table, copied("motion"), torch.cat((drive, unknown)))
        self._coming = Starts(*(copied(f"next_{name}") for name in Starts._fields))
        self._generator.set_state(snapshot["generator"])

    def _set_seed(self, seed: int | None) -> None:
        self._generator.manual_seed(0 if seed is None else seed)
        self._coming = self._draw_starts(0)

    def restart(self, rows: Tensor, again: Tensor | None = None) -> TensorDict:
        """Start an episode on the carts `rows` [R], new except for `again`; return their first frame, [R]."""
        table, motion, counts = self._next_starts(len(rows))
        if again is not None and again.any():
            table = torch.where(again, self._carts.table[:, rows], table)
            end = START_SHARE * CartParameters(table).track_half_length
            motion = torch.cat((motion[:1].clamp(-end, end), motion[1:]))
            counts = self._first_counts(table, motion)
        self._carts.table.index_copy_(1, rows, table)
        self._carts = Carts(
            self._carts.table,
            self._carts.motion.index_copy(1, rows, motion),
            self._carts.drive.index_fill(1, rows, 0),
        )
        no_motor = torch.zeros_like(counts[:1])
        return self.first_output(self._frame(counts, no_motor, no_motor.bool()))

    def _next_starts(self, count: int) -> Starts:
        if count > self._coming.counts.shape[1]:
            self._coming = self._draw_starts(max(count, DRAWN_AT_ONCE))
        taken = Starts(*(value[:, :count] for value in self._coming))
        self._coming = Starts(*(value[:, count:] for value in self._coming))
        return taken

    def _draw_starts(self, count: int) -> Starts:
        table = self.randomizer.draw(count, self._generator)
        motion = draw_start(count, self.start, self._generator).T.clone()
        motion[0] = within_track(motion[0], self.start, CartParameters(table).track_half_length)
        return Starts(table, motion, self._first_counts(table, motion))

    def _first_counts(self, table: Tensor, motion: Tensor) -> Tensor:
        noise = self._draw_noise(motion.shape[1])
        return encoder_counts(State(*motion), CartParameters(table), noise, self.hardware.encoders)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        """Return the first frame of the carts that reset; TorchRL keeps the others', which are zeros here."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return self.restart(torch.arange(self.carts, device=self.device))
        rows = mask.reshape(self.carts).nonzero().squeeze(-1)
        first = self.restart(rows)
        frame = first.new_zeros(self.batch_size)
        frame[rows] = first
        return frame

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        inputs = Inputs(tensordict.get("motor").T, self._draw_noise(self.carts))
        after = self._run(self._carts, inputs)
        self._carts = Carts(self._carts.table, after.motion, after.drive)
        return self.output(self._frame(after.counts, after.motor_applied, after.off_track))

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Drive the only cart for a period; the same physics as of many carts, as plain arithmetic."""
        inputs = Inputs(torch.tensor([[motor]]), self._draw_noise(1))
        if self._run_one is None:
            self._run_one = Scalar(self._plain_run, self._carts, inputs)
        after = self._run_one(*(tuple(map(plain, each)) for each in (self._carts, inputs)))
        self._carts = Carts(self._carts.table, column(after.motion), column(after.drive))
        return PlantOutput(after.counts, (self.period,), after.motor_applied, after.off_track, (False,))

    def _draw_noise(self, count: int) -> Tensor:
        """Return the noise of one period of `count` carts, [3, count]; 0 if no parameter is noisy."""
        if not self._noisy:
            return self._no_noise if count == self.carts else self._no_noise.new_zeros(3, count)
        draws = {"generator": self._generator, "device": self.device}
        return torch.cat((2 * torch.rand(1, count, **draws) - 1, torch.randn(2, count, **draws)))

    def _frame(self, counts: Tensor, motor_applied: Tensor, off_track: Tensor) -> PlantOutput[Tensor]:
        dt = torch.full(off_track.shape, self.period, device=self.device)
        return PlantOutput(counts, dt, motor_applied, off_track, torch.zeros_like(off_track))


def simulated_carts(
    plant: SimulatedSettings,
    config: "CartPoleSettings",
    draws: Draws,
    carts: int,
    start: StartSettings,
    seed: int,
    compiled: bool,
    device: torch.device | str,
) -> SimulatedPlant:
    """Return the plant of plant=simulated; `draws` is the source of its carts."""
    models, period = config.models(plant), config.control_period
    return SimulatedPlant(
        carts, draws, start, models, period, plant.substeps, seed, device, compiled, config.hardware
    )


def column(numbers: Sequence[float]) -> Tensor:
    """Return numbers as a column [k, 1] float32."""
    return torch.from_numpy(np.array(numbers, np.float32)).unsqueeze(1)
