"""N carts that move as a recorded one did: identified physics, and one member of an ensemble an episode.

The members differ where the recordings do not tell, so that an agent meets what is not known as well. Numbers
of the cart are drawn as by any simulated plant; what was learned is added to all of them.
"""

from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from cartpole_rl.compilation import Compiled
from cartpole_rl.physics.residual import UNDER_WAY, Residual, chosen_members
from cartpole_rl.plants.learned_model import LearnedModel
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.simulation import Carts, Given, Period, run_carts
from cartpole_rl.randomization.found import Draws
from cartpole_rl.tasks.settings import StartSettings


class Learned(NamedTuple):
    """What a period takes beside what every simulated cart takes: `Residual`, in one tuple with the draws."""

    member: Tensor  # [N] int64, of each cart's episode
    places: Tensor
    first: Tensor
    first_bias: Tensor
    second: Tensor
    second_bias: Tensor
    last: Tensor


def run_learned_carts(carts: Carts, given: Given, learned: Learned, **settings: Any) -> Period:
    """Run `run_carts` with the addition of the members of `learned`."""
    member, *weights = learned
    return run_carts(carts, given, addition=chosen_members(Residual(*weights), member), **settings)


class LearnedPlant(SimulatedPlant):
    """N carts of a learned model.

    `carts`, `start`, `seed`, `device` and `compiled` as of a simulated plant; `randomizer` draws the numbers
    of the carts, and has to allow UNDER_WAY motor values under way.
    """

    def __init__(
        self,
        carts: int,
        model: LearnedModel,
        randomizer: Draws,
        start: StartSettings,
        seed: int = 0,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ) -> None:
        super().__init__(
            carts,
            randomizer,
            start,
            model.models,
            model.period,
            model.substeps,
            seed,
            device,
            compiled,
        )
        self._member = torch.zeros(carts, dtype=torch.int64, device=self.device)
        if len(self._carts.drive) < 1 + UNDER_WAY:
            missing = self._carts.drive.new_zeros(1 + UNDER_WAY - len(self._carts.drive), carts)
            self._carts = self._carts._replace(drive=torch.cat((self._carts.drive, missing)))
        self._weights = Residual(*(part.to(self.device) for part in model.residual))
        run = partial(run_learned_carts, models=model.models, period=model.period, substeps=model.substeps)
        self._run_learned = Compiled(run) if compiled else run
        self._run = self._run_members

    @property
    def member(self) -> Tensor:
        """Which member moves each cart, [N]; changes in place when a row resets."""
        return self._member

    def _run_members(self, carts: Carts, given: Given) -> Period:
        return self._run_learned(carts, given, Learned(self._member, *self._weights))

    def restart(self, rows: Tensor, again: Tensor | None = None) -> TensorDict:
        """Begin a new episode on the carts `rows` [R], each with a member drawn for it, but for `again`."""
        drawn = torch.randint(
            self._weights.members, (len(rows),), generator=self._generator, device=self.device
        )
        if again is not None:
            drawn = torch.where(again, self._member[rows], drawn)
        self._member.index_copy_(0, rows, drawn)
        return super().restart(rows, again)

    def snapshot(self) -> dict[str, Any]:
        """All that the next step depends on; `restore` takes it back."""
        return {**super().snapshot(), "member": self._member.clone()}

    def restore(self, snapshot: Any) -> None:
        """Go on from `snapshot` as if nothing had happened."""
        super().restore(snapshot)
        self._member.copy_(snapshot["member"])
