"""Fine-tuning: a trained agent learns on, from one cart's recordings and from simulations of that cart.

Each round fits the simulator to all that was recorded, draws carts from what the fit leaves open, and learns
from both. The rest of the agent's life in simulation goes on as it was: same loop, same loss.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.learning.collector import COLLECTED
from cartpole_rl.learning.replay import n_step_transitions
from cartpole_rl.learning.settings import FinetuningSettings
from cartpole_rl.learning.training import Scalars, Training
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.draws import Draws
from cartpole_rl.tasks.episode import Episode


def recorded_chunk(
    episode: Episode,
    over: Callable[[RecordedPlant], CartPoleEnv],
    motors: Sequence[int],
    pole_length: float | None,
) -> TensorDictBase | None:
    """The one-step transitions [1, T] of an episode, as the environment `over` a recording sees them.

    `pole_length` m is that of the cart which was driven, None if it is not known. The last step before a lost
    link is left out: nothing was measured at its end. None is left of an episode that has no other step.
    """
    env = over(RecordedPlant(episode, pole_length))
    index = {motor: action for action, motor in enumerate(motors)}
    present, taken = env.reset(), []
    for motor in episode.motor[: episode.measured_steps].tolist():
        present["action"] = torch.tensor([index[motor]])
        transition, present = env.step_and_maybe_reset(present)
        taken.append(transition.select(*COLLECTED))
    return torch.stack(taken, 1) if taken else None


class Finetuning(Training):
    """A training that goes on from an agent's weights, on carts of a fit and on a cart's recordings."""

    def __init__(self, finetuning: FinetuningSettings, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.finetuning = finetuning
        self.recorded: TensorDictBase | None = None
        self._chooser = torch.Generator().manual_seed(0)

    def add(self, chunk: TensorDictBase | None) -> None:
        """Learn from one more recorded episode, if there is anything in it."""
        if chunk is None:
            return
        transitions = n_step_transitions(chunk, self.settings.n_step, self.agent.settings.gamma)
        known = self.recorded
        self.recorded = transitions if known is None else torch.cat((known, transitions))

    def simulate(self, carts: Draws) -> None:
        """Go on with simulated carts drawn from `carts`; what older ones taught is forgotten."""
        assert isinstance(self.env.plant, SimulatedPlant)
        self.env.plant.replace_randomizer(carts)
        self.collector.reset()
        self.returns.reset()
        self.replay.empty()
        self.fill()

    def fill(self) -> None:
        """Drive the simulated carts for a whole episode, so that the first updates see all of one."""
        for _ in range(self.env.hardware.task.time_limit // self.settings.chunk):
            self.collect()

    def round(self) -> Scalars:
        """Learn while one episode is driven."""
        scalars: Scalars = {}
        for _ in range(self.finetuning.iterations):
            chunk, learned = self.iterate()
            scalars = learned | self.describe(chunk)
        return scalars

    def sample(self) -> TensorDictBase:
        """Simulated transitions, with recorded ones in `cart_share` of the places, scattered."""
        simulated = self.replay.sample()
        if self.recorded is None or self.finetuning.cart_share == 0:
            return simulated
        count = len(simulated)
        places = torch.rand(count, generator=self._chooser) < self.finetuning.cart_share
        which = torch.randint(len(self.recorded), (int(places.sum()),), generator=self._chooser)
        mixed = simulated.select(*self.recorded.keys(True, True)).clone()
        mixed[places] = self.recorded[which]
        return mixed
