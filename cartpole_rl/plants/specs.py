"""The contract of every plant: its inputs and outputs, with shapes and types."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cartpole_rl.errors import ConfigError, PlantError
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware, nominal_hardware
from cartpole_rl.tasks.episode import Ending, Origin
from cartpole_rl.wire.messages import Fault

TERMINATING, TRUNCATING = (Ending.TRACK,), (Ending.FAULT, Ending.LINK)  # the endings that plants report


Values = TypeVar("Values")  # Tensor, or Numbers
Numbers = tuple[Any, ...]  # of one cart: the k numbers of a [k, 1] tensor


class PlantOutput(NamedTuple, Generic[Values]):
    """The output of a plant after a period: see `Plant`.

    Each entry is a tensor [k, N], the transpose of the tensordict's, or the k numbers of one cart.
    """

    counts: Values  # [2, N] int64
    dt: Values  # [1, N] float32
    motor_applied: Values  # [1, N] int64
    terminated: Values  # [1, N] bool
    truncated: Values  # [1, N] bool

    @property
    def ends(self) -> bool:
        """True for one cart whose episode ends."""
        return bool(self.terminated[0] or self.truncated[0])  # type: ignore[index]


class Plant(EnvBase):
    """A batch of N carts that take motor values and return encoder counts; simulated, or one cart on a wire.

    In, each period: `motor` [N, 1] int64, -255 to 255, positive to the right. A plant that was driven by
    another value, as 0 in place of a late one, writes it there.
    Out: `counts` [N, 2] int64 (cart from the middle of the track, pole from upright, both positive to the
    right, the pole not wrapped), `dt` [N, 1] float32 seconds since the previous frame by the plant's clock,
    `motor_applied` [N, 1] int64, `terminated` [N, 1] bool (left the track),
    `truncated` [N, 1] bool (link lost, or a device fault; time limits belong to the task).
    A plant computes no reward; it returns zeros.
    """

    compiled = False  # whether the hardware transform above it may compile its arithmetic as well
    drives_one_cart = False  # by `reset_one` and `step_one`, on plain numbers
    ended_by = ""  # the `Ending` that a plant of one cart reports; "" while it reports none
    before_start: Callable[[], None] | None = None  # called before the cart on a port is armed
    on_command: Callable[[int], None] | None = None  # called with each motor value once it is sent to a cart

    def __init__(
        self, carts: int, device: torch.device | str = "cpu", hardware: Hardware | None = None
    ) -> None:
        """`hardware` is that of the carts, ip02's if it is not given."""
        super().__init__(device=torch.device(device), batch_size=torch.Size([carts]))
        self.hardware = hardware or nominal_hardware()
        single: dict[str, Any] = {"shape": (carts, 1), "device": device}
        motor = Bounded(-LARGEST_MOTOR, LARGEST_MOTOR, dtype=torch.int64, **single)
        self.action_spec = Composite(motor=motor, shape=(carts,))
        self.observation_spec = Composite(
            counts=Unbounded(shape=(carts, 2), dtype=torch.int64, device=device),
            dt=Unbounded(dtype=torch.float32, **single),
            motor_applied=motor.clone(),
            shape=(carts,),
        )
        self.reward_spec = Unbounded(**single)
        self.done_spec = Composite(
            {key: Binary(dtype=torch.bool, **single) for key in ("done", "terminated", "truncated")},
            shape=(carts,),
        )

    def to(self, device: torch.device | str) -> Self:
        """Return the plant if it is on `device`. Raises ConfigError for another one: it stays where it is."""
        wanted = torch.device(device)
        both = {wanted.index, self.device.index}
        if wanted.type != self.device.type or (None not in both and len(both) > 1):
            raise ConfigError(
                f"the plant was made on {self.device}; make it on {device} in place of moving it"
            )
        return self

    @property
    def pole_length(self) -> torch.Tensor:
        """m, [N]: twice the distance from pivot to centre of mass; observed by a length-aware agent."""
        raise NotImplementedError

    @property
    def track_half_length(self) -> torch.Tensor:
        """m, [N]: from the middle of the track to its end, or to the soft limit. The track guard reads it."""
        raise NotImplementedError

    @property
    def fault(self) -> Fault:
        """The faults that a plant of one cart has latched."""
        return Fault.NONE

    @property
    def statistics(self) -> LinkStatistics:
        """Frames and times on the link to a cart; zeros without a link."""
        return LinkStatistics()

    def link_figures(self) -> dict[str, Any]:
        """Return the counts of lost, damaged and late frames."""
        return {name: getattr(self.statistics, name) for name in ("late_ticks", "lost_frames", "bad_frames")}

    def check_policy(self, identity: int) -> None:
        """Raise PlantError unless the cart's board has the agent of this `identity`."""
        raise PlantError("only a cart on a port can have an agent on its board")

    def halt(self) -> None:
        """Set the motor to 0 until the next reset. Nothing moves a simulated cart that is not stepped."""

    def distrust(self) -> None:
        """Find the zeros anew in the next reset: a count froze or jumped. Simulated carts need not."""

    def origins(self) -> Sequence[Origin | None]:
        """Return the cart and the true state of each row, [N], right after a reset; None if unknown."""
        return [None] * self.carts

    @property
    def true_state(self) -> State:
        """The state of simulated carts that no encoder sees, [N] each."""
        raise NotImplementedError

    def place(self, state: State) -> None:
        """Put simulated carts into `state`."""
        raise NotImplementedError

    def start_from(self, state: Mapping[str, float]) -> None:
        """Start the next episode of every simulated cart in this true state; `Origin` has the units."""
        raise NotImplementedError

    def replace_randomizer(self, randomizer: Draws) -> None:
        """Draw the next episodes of simulated carts from `randomizer`."""
        raise NotImplementedError

    def restart(self, rows: torch.Tensor, again: torch.Tensor | None = None) -> TensorDict:
        """Start a new episode on the carts `rows`, [R] int64; return their first frame, [R].

        Carts in `again`, [R] bool, keep their parameters if parameters are drawn.
        """
        mask = torch.zeros(self.carts, 1, dtype=torch.bool, device=self.device)
        mask[rows] = True
        return self._reset(TensorDict({"_reset": mask}, self.batch_size))[rows]

    def reset_one(self) -> PlantOutput[Numbers]:
        """Start a new episode of a plant of one cart; return its first frame."""
        return one_frame(self._reset())

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Drive a plant of one cart for a period under a motor value; return the frame at its end."""
        return one_frame(self._step(tensordict_of({"motor": torch.tensor([[motor]])})))

    def drove(self, given: int) -> int:
        """Return the motor value that drove the newest period of one cart, where `given` was the one to send.

        It is another one if that was late or lost.
        """
        return given

    @property
    def carts(self) -> int:
        """N, the number of carts in the batch."""
        return self.batch_size[0]

    def first_output(self, frame: PlantOutput[torch.Tensor]) -> TensorDict:
        """Return the result of `_reset`, of all carts or some; `done` is `terminated | truncated`."""
        done = (frame.terminated | frame.truncated).T
        return tensordict_of({key: value.T for key, value in frame._asdict().items()} | {"done": done})

    def output(self, frame: PlantOutput[torch.Tensor]) -> TensorDict:
        """Return the result of `_step`: as `first_output`, and the reward 0 for TorchRL."""
        return self.first_output(frame).set("reward", torch.zeros_like(frame.dt.T))


def tensordict_of(entries: dict[str, Any]) -> TensorDict:
    """Return a tensordict of entries [N, ...] on one device that are known to fit together.

    The only use of a private part of TensorDict: the checks of its public constructor take longer than the
    physics of a thousand carts. `TensorDict(entries, batch_size, device=...)` has the same result.
    """
    first = next(iter(entries.values()))
    return TensorDict._new_unsafe(entries, batch_size=first.shape[:1], device=first.device)


def one_frame(output: TensorDictBase) -> PlantOutput[Numbers]:
    """Return the frame of a plant of one cart as plain numbers."""
    return PlantOutput(*(tuple(output[key][0].tolist()) for key in PlantOutput._fields))


class OneCartPlant(Plant):
    """A plant of one cart, [1], that overrides `reset_one` and `step_one`; `_reset` and `_step` call them."""

    drives_one_cart = True

    def __init__(self, hardware: Hardware | None = None) -> None:
        super().__init__(carts=1, hardware=hardware)

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing: a real cart has its own randomness, an emulated one its own seed, a recording none."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        return self.first_output(on_tensors(self.reset_one()))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        given = int(tensordict["motor"])
        frame = self.step_one(given)
        if (drove := self.drove(given)) != given:
            tensordict["motor"] = torch.tensor([[drove]])
        return self.output(on_tensors(frame))


def on_tensors(frame: PlantOutput[Numbers]) -> PlantOutput[torch.Tensor]:
    """Return the frame of one cart on tensors. NumPy is five times as fast as torch.tensor."""
    columns = (np.array([values], kind).T for values, kind in zip(frame, TYPES, strict=True))
    return PlantOutput(*map(torch.from_numpy, columns))


TYPES: tuple[type[np.generic], ...] = (np.int64, np.float32, np.int64, np.bool_, np.bool_)  # of an output
