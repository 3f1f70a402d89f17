"""A recorded episode as a plant: it plays back the recorded frames, whatever motor values it gets.

Under the hardware transform it gives the observations, rewards and endings that the same code gave, or would
have given, while the cart was driven.
"""

import torch
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import TERMINATING, TRUNCATING, Numbers, OneCartPlant, PlantOutput
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.tasks.episode import Episode


class RecordedPlant(OneCartPlant):
    """One cart, [1]; each step returns the next recorded frame, the last of which ends the episode.

    `pole_length` in m is twice the distance from pivot to centre of mass of the recorded pole; None if it is
    unknown.
    """

    def __init__(self, episode: Episode, pole_length: float | None, hardware: Hardware | None = None) -> None:
        super().__init__(hardware)
        self.episode = episode
        self._pole_length = pole_length
        self._row = 0

    @property
    def pole_length(self) -> Tensor:
        """m, [1]. Raises ConfigError if it is unknown."""
        if self._pole_length is None:
            raise ConfigError("this agent observes the pole's length, which the recording does not have")
        return torch.tensor([self._pole_length])

    @property
    def track_half_length(self) -> Tensor:
        """Unbounded, [1]: the recorded motor values include those of the track guard."""
        return torch.tensor([torch.inf])

    def reset_one(self) -> PlantOutput[Numbers]:
        """Return to the first frame."""
        self._row = 0
        return self._frame()

    def step_one(self, motor: int) -> PlantOutput[Numbers]:
        """Return the next frame, whatever the motor value: the recorded one drove."""
        self._row += 1
        return self._frame()

    def drove(self, given: int) -> int:
        """Return the recorded motor value of the newest period."""
        return int(self.episode.motor[self._row - 1])

    def _frame(self) -> PlantOutput[Numbers]:
        episode, row = self.episode, self._row
        cart, pole = episode.counts[row].tolist()
        since = float(episode.time[row] - episode.time[max(0, row - 1)])
        motor = int(episode.motor[row - 1]) if row else 0
        ending = episode.ended_by if row == episode.steps else ""
        ends = (ending in TERMINATING,), (ending in TRUNCATING,)
        return PlantOutput((cart, pole), (since,), (motor,), *ends)
