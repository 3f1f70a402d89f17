"""Put an environment together: a plant and the hardware transform."""

from torchrl.envs import TransformedEnv

from cartpole_rl.envs.hardware import HardwareTransform, ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.plants.specs import Plant
from cartpole_rl.tasks.actions import ActionSettings


class CartPoleEnv(TransformedEnv):
    """A plant under the hardware transform; `plant` and `hardware` are the two by name."""

    @property
    def plant(self) -> Plant:
        """The plant below."""
        return self.base_env

    @property
    def hardware(self) -> HardwareTransform:
        """The transform above it."""
        return self.transform


def make_env(
    plant: Plant,
    actions: ActionSettings,
    task: TaskSettings,
    observation: ObservationSettings,
    reward: RewardSettings,
) -> CartPoleEnv:
    """The environment over `plant`, with the same specs whichever plant it is."""
    return CartPoleEnv(plant, HardwareTransform(actions.motors, task, observation, reward))
