"""N simulated carts as one plant: physics, encoders, delays, and parameters drawn anew for each episode.

The true state lives here and stays here; what leaves is what a cart's serial port would say.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.physics.dynamics import Drive, Models, State, run_period
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.specs import Plant
from cartpole_rl.randomization import Randomizer
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.tasks.starts import StartSettings, draw_start


class SimulatedPlant(Plant):
    """N simulated carts.

    `period` s is one control period, integrated in `substeps` steps. Parameters and the start are drawn
    inside the reset, for the rows that reset; `parameters` reads the values in force. `compiled` physics is
    several times as fast, needs a C++ compiler and costs some seconds once.
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
        self.randomizer, self.start, self.models = randomizer, start, models
        self.period, self.substeps = period, substeps
        self._run_period = torch.compile(run_period, fullgraph=True) if compiled else run_period
        self._generator = torch.Generator(device=self.device)
        self.set_seed(seed)
        delay = randomizer.longest_delay()
        self._commands = 1 + max(1, math.ceil(delay / period - 1e-9))  # motor values that can be under way
        self._jitters = randomizer.can_differ_from_zero("latency_jitter")
        self._noisy = randomizer.can_differ_from_zero("position_noise") or randomizer.can_differ_from_zero(
            "angle_noise"
        )
        self._table = randomizer.nominal.unsqueeze(1).repeat(1, carts)  # [P, N]
        self._cart = CartParameters.from_table(self._table)  # its fields share the table's memory
        self._state = State(*torch.zeros(4, carts, device=self.device).unbind(0))
        self._drive = Drive(self._zeros(), torch.zeros(self._commands, carts, device=self.device))

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

    def _zeros(self) -> Tensor:
        return torch.zeros(self.carts, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._generator.manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = (
            torch.arange(self.carts, device=self.device)
            if mask is None
            else mask.reshape(self.carts).nonzero().squeeze(-1)
        )
        self._table[:, rows] = self.randomizer.draw(len(rows), self._generator)
        drawn = draw_start(len(rows), self.start, self._generator)
        self._state = State(
            *(old.index_copy(0, rows, new) for old, new in zip(self._state, drawn.unbind(1), strict=True))
        )
        force, motors = self._drive
        self._drive = Drive(force.index_fill(0, rows, 0), motors.index_fill(1, rows, 0))
        return self.frame(*self._report(self._zeros().bool()))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        motor = tensordict.get("motor").T.to(self._drive.motors.dtype)
        motors = torch.cat((motor, self._drive.motors[:-1]))
        cart = self.parameters
        self._state, self._drive = self._run_period(
            self._state,
            Drive(self._drive.force, motors),
            self._latency(cart),
            cart,
            self.models,
            self.period,
            self.substeps,
        )
        return self.step_frame(*self._report(self._state.x.abs() > cart.track_half_length))

    def _latency(self, cart: CartParameters) -> Tensor:
        if not self._jitters:
            return cart.latency
        unit = 2 * torch.rand(self.carts, generator=self._generator, device=self.device) - 1
        return (cart.latency + unit * cart.latency_jitter).clamp(min=0)

    def _report(self, off_track: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What the carts would say now: counts, dt, motor_applied, terminated, truncated."""
        return (
            self._encoders(),
            torch.full((self.carts, 1), self.period, device=self.device),
            self._motor_in_force(),
            off_track.unsqueeze(1),
            torch.zeros(self.carts, 1, dtype=torch.bool, device=self.device),
        )

    def _motor_in_force(self) -> Tensor:
        """Motor value [N, 1] whose delay has passed by now."""
        age = (self.parameters.latency / self.period - 1).ceil().clamp(min=0).long()
        return self._drive.motors.gather(0, age.unsqueeze(0)).T.long()

    def _encoders(self) -> Tensor:
        """Counts [N, 2] of the true state, with the zero's error and noise."""
        cart = self.parameters
        x, theta = self._state.x, self._state.theta + cart.angle_offset
        if self._noisy:
            noise = torch.randn((2, self.carts), generator=self._generator, device=self.device)
            x, theta = x + noise[0] * cart.position_noise, theta + noise[1] * cart.angle_noise
        return torch.stack((x / CART_METRES_PER_COUNT, theta / POLE_RADIANS_PER_COUNT), 1).round().long()
