"""The contract that every plant keeps: what goes in, what comes out, in which shape and type."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cartpole_rl.tasks.episode import Origin

MOTOR_LIMIT = 255


class Plant(EnvBase):
    """A batch of N carts that speak encoder counts and motor values; simulated, or one cart on a wire.

    In, each period: `motor` [N, 1] int64, -255 to 255, positive to the right.
    Out: `counts` [N, 2] int64 (cart from the middle of the track, pole from upright, both positive to the
    right, the pole not wrapped), `dt` [N, 1] float32 seconds since the previous frame by the plant's clock,
    `motor_applied` [N, 1] int64, `terminated` [N, 1] bool (left the track, or a device fault),
    `truncated` [N, 1] bool (link lost; time limits belong to the task).
    A plant has no reward of its own and gives zeros.
    """

    compiled = False  # whether what stands above may compile its arithmetic as well

    def __init__(self, carts: int, device: torch.device | str = "cpu") -> None:
        super().__init__(device=torch.device(device), batch_size=torch.Size([carts]))
        self.action_spec = Composite(
            motor=Bounded(-MOTOR_LIMIT, MOTOR_LIMIT, shape=(carts, 1), dtype=torch.int64, device=device),
            shape=(carts,),
        )
        self.observation_spec = Composite(
            counts=Unbounded(shape=(carts, 2), dtype=torch.int64, device=device),
            dt=Unbounded(shape=(carts, 1), dtype=torch.float32, device=device),
            motor_applied=Bounded(
                -MOTOR_LIMIT, MOTOR_LIMIT, shape=(carts, 1), dtype=torch.int64, device=device
            ),
            shape=(carts,),
        )
        self.reward_spec = Unbounded(shape=(carts, 1), device=device)
        self.done_spec = Composite(
            {key: Binary(shape=(carts, 1), dtype=torch.bool, device=device) for key in DONE_KEYS},
            shape=(carts,),
        )

    @property
    def pole_length(self) -> torch.Tensor:
        """m, [N]: twice the distance from pivot to centre of mass; what a length-aware agent observes."""
        raise NotImplementedError

    def halt(self) -> None:
        """Motor to 0 until the next reset. A simulated cart stands still anyway when nobody steps it."""

    def origins(self) -> Sequence[Origin | None]:
        """The cart and the true state of each row, [N], right after a reset; None where nobody knows them."""
        return [None] * self.carts

    def restart(self, rows: torch.Tensor, again: torch.Tensor | None = None) -> TensorDict:
        """Begin a new episode on the carts `rows`, [R] int64; their first frame, [R].

        Where carts are drawn, those in `again`, [R] bool, stay as they are.
        """
        mask = torch.zeros(self.carts, 1, dtype=torch.bool, device=self.device)
        mask[rows] = True
        return self._reset(TensorDict({"_reset": mask}, self.batch_size))[rows]

    @property
    def carts(self) -> int:
        """N, the number of carts in the batch."""
        return self.batch_size[0]

    def frame(
        self,
        counts: torch.Tensor,
        dt: torch.Tensor,
        motor_applied: torch.Tensor,
        terminated: torch.Tensor,
        truncated: torch.Tensor,
    ) -> TensorDict:
        """What `_reset` returns, of all carts or some; `done` is `terminated | truncated`."""
        return tensordict_of(
            {
                "counts": counts,
                "dt": dt,
                "motor_applied": motor_applied,
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def step_frame(self, *frame: torch.Tensor) -> TensorDict:
        """What `_step` returns: `frame` of the same arguments, and the reward 0, which TorchRL asks for."""
        result = self.frame(*frame)
        return result.set("reward", torch.zeros_like(result.get("dt")))


def tensordict_of(entries: dict[str, Any]) -> TensorDict:
    """A tensordict of entries [N, ...] on one device that are known to fit together.

    What TensorDict's constructor checks takes longer than the physics of a thousand carts.
    """
    first = next(iter(entries.values()))
    return TensorDict._new_unsafe(entries, batch_size=first.shape[:1], device=first.device)


def one_cart(
    counts: Sequence[int], dt: float, motor_applied: int, terminated: bool, truncated: bool
) -> tuple[torch.Tensor, ...]:
    """The arguments of `Plant.frame` for a single cart.

    A cart waits for them, and torch.tensor takes five times as long as NumPy.
    """
    rows = (
        np.array([counts], np.int64),
        np.array([[dt]], np.float32),
        np.array([[motor_applied]], np.int64),
        np.array([[terminated]]),
        np.array([[truncated]]),
    )
    return tuple(map(torch.from_numpy, rows))


DONE_KEYS = ("done", "terminated", "truncated")
