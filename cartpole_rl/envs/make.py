"""Put an environment together: a plant and the hardware transform."""

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.envs.settings import ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.plants.specs import Plant, tensordict_of
from cartpole_rl.tasks.actions import ActionSettings


class CartPoleEnv(TransformedEnv):
    """A plant under the hardware transform; `plant` and `hardware` are the two by name.

    Steps are those of TorchRL's TransformedEnv, key by key, at a fraction of its cost: it copies the
    tensordict on the way down and again on the way up, and resets every row to keep those that ended.
    """

    @property
    def plant(self) -> Plant:
        """The plant below."""
        return self.base_env

    @property
    def hardware(self) -> HardwareTransform:
        """The transform above it."""
        return self.transform

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """`tensordict` with the outcome of one step of all carts under "next"; nothing is checked."""
        return tensordict.set("next", self._step(tensordict))

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """One step, and the first frame of a new episode for each cart whose episode ended.

        Returns `tensordict` with the step's outcome under "next", and what the next step starts from.
        """
        stepped = self.step(tensordict)
        return stepped, self.advance(stepped)

    def advance(self, stepped: TensorDictBase, again: Tensor | None = None) -> TensorDictBase:
        """What the step after `stepped` starts from: a new episode's first frame where the last one ended.

        A cart whose episode ended and that is in `again`, [N] bool, stays the cart that it is; the others
        become new ones. A real cart is always the same.
        """
        following = stepped.get("next")
        present = dict(stepped.items()) | dict(following.items())
        del present["reward"]  # belongs to the step that was made
        del present["next"]
        ended = following.get("done").squeeze(-1).nonzero().squeeze(-1)
        if len(ended):
            frames = self.plant.restart(ended, None if again is None else again[ended])
            first = self.hardware.reset_rows(frames, ended)
            present |= {key: replaced(present[key], ended, value) for key, value in first.items()}
        return tensordict_of(present)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        command = self.hardware.command(tensordict)
        return self.hardware.perceive(tensordict, command, self.plant._step(command))


def replaced(values: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """`values` [N, k] with `new` [R, k] in the rows [R]; several times as fast along the last dimension."""
    return values.T.index_copy(1, rows, new.T).T


def make_env(
    plant: Plant,
    actions: ActionSettings,
    task: TaskSettings,
    observation: ObservationSettings,
    reward: RewardSettings,
) -> CartPoleEnv:
    """The environment over `plant`, with the same specs whichever plant it is."""
    hardware = HardwareTransform(actions.motors, task, observation, reward, compiled=plant.compiled)
    return CartPoleEnv(plant, hardware)
