"""Fine-tuning of a trained agent with recordings of one cart and simulations of it.

The simulator is fitted to all recordings; carts are drawn from the uncertainty of the fit. Training then
continues on both, with the same loop and the same loss.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.learning.dqn import COLLECTED, Scalars, Training, n_step_transitions
from cartpole_rl.learning.settings import FinetuningSettings
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.tasks.episode import Episode


def recorded_chunks(
    episode: Episode,
    make_env: Callable[[RecordedPlant], CartPoleEnv],
    motors: Sequence[int],
    pole_length: float | None,
    hardware: Hardware | None = None,
) -> list[TensorDictBase]:
    """Return the one-step transitions of an episode in the environment that `make_env` builds.

    `pole_length` m is that of the cart, None if it is not known; `hardware` is the cart's, ip02's if it is
    not given. The last step before a lost link is left out, since its outcome was not measured. So are the
    steps that no action of the agent drove, such as those of the firmware's brake or of a late value, and
    those at whose end a frame came late or was lost: they part the episode into chunks [1, T].
    """
    env = make_env(RecordedPlant(episode, pole_length, hardware))
    index = {motor: action for action, motor in enumerate(motors)}
    current = env.reset()
    parts: list[list[TensorDictBase]] = [[]]
    regular = episode.regular_frames(float(np.median(np.diff(episode.time))) if episode.steps else 1.0)
    for motor, in_time in zip(episode.motor[: episode.measured_steps].tolist(), regular, strict=False):
        current["action"] = torch.tensor([index.get(motor, 0)])
        transition, current = env.step_and_maybe_reset(current)
        if in_time and motor in index:
            parts[-1].append(transition.select(*COLLECTED))
        else:
            parts.append([])
    return [torch.stack(part, 1) for part in parts if part]


class Finetuning(Training):
    """A training of a trained agent, on simulated carts of a fit and on recordings of a cart."""

    def __init__(self, finetuning: FinetuningSettings, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.finetuning = finetuning
        self.recorded: TensorDictBase | None = None
        self._chooser = torch.Generator().manual_seed(self.seed)

    def add(self, chunks: Sequence[TensorDictBase]) -> None:
        """Add the chunks of a recorded episode."""
        for chunk in chunks:
            transitions = n_step_transitions(chunk, self.settings.steps, self.agent.settings.discount)
            earlier = self.recorded
            self.recorded = transitions if earlier is None else torch.cat((earlier, transitions))

    def simulate(self, carts: Draws) -> None:
        """Continue on simulated carts drawn from `carts`; the transitions of older ones are discarded."""
        self.env.plant.replace_randomizer(carts)
        self.start_episodes()
        self.buffer.empty()
        self.fill()

    def fill(self) -> None:
        """Collect a whole episode of each simulated cart, so that the buffer holds all parts of it."""
        for _ in range(self.env.hardware.task.periods // self.settings.chunk):
            self.collect()

    def round(self) -> Scalars:
        """Run the iterations that belong to one episode of the cart."""
        scalars: Scalars = {}
        for _ in range(self.finetuning.iterations):
            chunk, scalars = self.iterate()
            scalars |= self.describe(chunk)
        return scalars

    def sample(self) -> TensorDictBase:
        """Return simulated transitions, a random `cart_share` of them replaced by recorded ones."""
        simulated = self.buffer.sample()
        if self.recorded is None or self.finetuning.cart_share == 0:
            return simulated
        count = len(simulated)
        places = torch.rand(count, generator=self._chooser) < self.finetuning.cart_share
        which = torch.randint(len(self.recorded), (int(places.sum()),), generator=self._chooser)
        mixed = simulated.select(*self.recorded.keys(True, True)).clone()
        mixed[places] = self.recorded[which]
        return mixed

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the training, without the recorded transitions."""
        return {**super().snapshot(), "chooser": self._chooser.get_state()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`."""
        super().restore(snapshot)
        self._chooser.set_state(snapshot["chooser"])
