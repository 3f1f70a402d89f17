"""N simulated carts as one plant: parameters and starts drawn anew for each episode, physics, encoders.

The true state lives here and stays here; what leaves is what a cart's serial port would say.
"""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.compilation import Compiled
from cartpole_rl.physics.dynamics import Drive, Models, State
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulation import Cart, Chance, Command, Encoders, encoder_counts, run_carts
from cartpole_rl.plants.specs import Plant
from cartpole_rl.randomization import Randomizer
from cartpole_rl.tasks.starts import StartSettings, draw_start

OF_CHANCE = ("latency_jitter", "position_noise", "angle_noise")  # drawn anew in each period


class SimulatedPlant(Plant):
    """N simulated carts.

    `period` s is one control period, integrated in `substeps` steps. Parameters and the start are drawn
    inside the reset, for the rows that reset; `parameters` reads the values in force. A `compiled` plant and
    the hardware transform over it are several times as fast, need a C++ compiler and cost some seconds once.
    """

    def __init__(
        self,
        carts: int,
        randomizer: Randomizer,
        start: StartSettings,
        models: Models,
        period: float = 0.02,
        substeps: int = 4,
        seed: int = 0,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ) -> None:
        super().__init__(carts, device)
        self.compiled = compiled
        self.randomizer, self.start, self.models = randomizer, start, models
        self.period, self.substeps = period, substeps
        run = partial(run_carts, models=models, period=period, substeps=substeps)
        self._run = Compiled(run) if compiled else run
        self._generator = torch.Generator(device=self.device)
        self.set_seed(seed)
        delay = randomizer.longest_delay()
        commands = 1 + max(1, math.ceil(delay / period - 1e-9))  # motor values that can be under way
        self._chancy = any(randomizer.can_differ_from_zero(name) for name in OF_CHANCE)
        self._table = randomizer.nominal.unsqueeze(1).repeat(1, carts)  # [P, N]
        self._cart = CartParameters.from_table(self._table)  # its fields share the table's memory
        self._encoder_rows = [CartParameters.names().index(name) for name in Encoders._fields]
        zeros = partial(torch.zeros, device=self.device)
        self._no_chance = Chance(*zeros(3, carts))
        self._state = State(*zeros(4, carts))
        self._drive = Drive(zeros(carts), zeros(commands, carts))

    @property
    def parameters(self) -> CartParameters:
        """The parameters in force, [N]; they change in place when a row resets: clone what is to be kept."""
        return self._cart

    @property
    def true_state(self) -> State:
        """The state that no encoder sees, [N] each."""
        return self._state

    @property
    def pole_length(self) -> Tensor:
        """m, [N]: 2 l of the pole that each cart carries."""
        return self.parameters.pole_length

    def place(self, state: State) -> None:
        """Put the carts into `state`; for tests, knocks and replay."""
        self._state = State(*(value.to(self.device).clone() for value in state))

    def snapshot(self) -> dict[str, Any]:
        """All that the next step depends on; `restore` takes it back."""
        return {
            "table": self._table.clone(),
            "state": torch.stack(self._state),
            "force": self._drive.force.clone(),
            "motors": self._drive.motors.clone(),
            "generator": self._generator.get_state(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from `snapshot` as if nothing had happened."""
        self._table.copy_(snapshot["table"])
        self._state = State(*snapshot["state"].clone().unbind(0))
        self._drive = Drive(snapshot["force"].clone(), snapshot["motors"].clone())
        self._generator.set_state(snapshot["generator"])

    def _set_seed(self, seed: int | None) -> None:
        self._generator.manual_seed(0 if seed is None else seed)

    def restart(self, rows: Tensor) -> TensorDict:
        """Draw new parameters and a new start for the carts `rows` [R]; their first frame, [R]."""
        count = len(rows)
        table = self.randomizer.draw(count, self._generator)
        start = draw_start(count, self.start, self._generator)
        state = State(*start.unbind(1))
        self._table.index_copy_(1, rows, table)
        self._state = State(
            *(old.index_copy(0, rows, new) for old, new in zip(self._state, state, strict=True))
        )
        self._drive = Drive(*(old.index_fill(-1, rows, 0) for old in self._drive))
        counts = encoder_counts(state, Encoders(*table[self._encoder_rows]), self._chance(count))
        no_motor = counts.new_zeros(count, 1)
        return self.frame(*self._report(counts, no_motor, no_motor.bool()))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        """The first frame of the carts that reset; TorchRL keeps the others', which are zeros here."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return self.restart(torch.arange(self.carts, device=self.device))
        rows = mask.reshape(self.carts).nonzero().squeeze(-1)
        first = self.restart(rows)
        frame = first.new_zeros(self.batch_size)
        frame[rows] = first
        return frame

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        command = Command(tensordict.get("motor"))
        after = self._run(self._state, self._drive, command, Cart(self._table), self._chance(self.carts))
        self._state, self._drive = after.state, after.drive
        return self.step_frame(*self._report(after.counts, after.motor_applied, after.off_track))

    def _report(self, counts: Tensor, motor_applied: Tensor, off_track: Tensor) -> tuple[Tensor, ...]:
        """The arguments of `frame`."""
        dt = torch.full(off_track.shape, self.period, device=self.device)
        return counts, dt, motor_applied, off_track, torch.zeros_like(off_track)

    def _chance(self, count: int) -> Chance:
        """The draws for one period of `count` carts, or 0 where nothing is left to chance."""
        if not self._chancy:
            return Chance(*(value[:count] for value in self._no_chance))
        draws = {"generator": self._generator, "device": self.device}
        return Chance(2 * torch.rand(count, **draws) - 1, *torch.randn(2, count, **draws))
