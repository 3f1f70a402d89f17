"""The simulated environments for Gymnasium: one cart, or many at once.

    gymnasium.make("cartpole_rl/SwingUp-v0")
    gymnasium.make_vec("cartpole_rl/Balance-v0", num_envs=1024, vectorization_mode="vector_entry_point")

Both wrap the same `CartPoleEnv` as everything else, with the nominal cart and the medium pole of conf/.

| task    | actions                                     | reward                             | ends          |
|---------|---------------------------------------------|------------------------------------|---------------|
| swingup | nine motor values, conf/actions/nine_levels | (6.2), as in conf/reward/score     | track         |
| balance | left, none, right, conf/actions/three       | (6.1), as in conf/reward/position  | track, 12 deg |

An episode is truncated after 10 s. An action is an index of the motor values, from full left to full right.
The track guard (envs/guard.py) replaces them near the end of the track.
`info` has the step's scores (6.1) `score_upright` and (6.2) `score`. The observation is a Box of float32
without bounds, as in conf/train.yaml:

| index | observation                       | unit    |
|-------|-----------------------------------|---------|
| 0     | x, positive right                 | 0.38 m  |
| 1     | x_dot                             | 1 m/s   |
| 2, 3  | cos and sin of theta, 0 upright   | 1       |
| 4     | theta_dot                         | 8 rad/s |
| 5-7   | last motor values, newest first   | 255     |
| 8, 9  | x_dot and theta_dot, a step ago   | as 1, 4 |
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import shipped_settings, simulated_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.plants.settings import SimulatedSettings

OF_TASK = {
    "swingup": {"task": "swingup", "actions": "nine_levels", "reward": "score"},
    "balance": {"task": "balance", "actions": "three", "reward": "position"},
}
SCORES = ("score", "score_upright")

Array = NDArray[Any]
Randomization = str | Mapping[str, Mapping[str, Any]]


def simulated_environment(
    task: str, carts: int, randomization: Randomization = "none", compiled: bool = False
) -> CartPoleEnv:
    """Return the environment of `task`, "swingup" or "balance", with the other choices of conf/train.yaml.

    `randomization` is the name of a file in conf/randomization/, or its lines. Raises ConfigError.
    """
    settings = shipped_settings({**OF_TASK[task], "pole": "medium", "randomization": randomization})
    plant = SimulatedSettings(**choice("plant/simulated"))
    return simulated_env(settings, plant, carts, settings.task.start, seed=0, compiled=compiled)


def observation_space(env: CartPoleEnv) -> spaces.Box:
    """Return the observation space of one cart."""
    return spaces.Box(-np.inf, np.inf, (env.hardware.observation_settings.size,), np.float32)


def action_space(env: CartPoleEnv) -> spaces.Discrete:
    """Return the action space of one cart: an index of its motor values."""
    return spaces.Discrete(len(env.hardware.motors))


class CartPoleGymnasium(gymnasium.Env[Array, np.int64]):
    """One simulated cart."""

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(self, task: str, randomization: Randomization = "none", render_mode: None = None) -> None:
        self.env = simulated_environment(task, 1, randomization)
        self.observation_space, self.action_space = observation_space(self.env), action_space(self.env)
        self.render_mode = render_mode
        self.seeded = False  # the plant, from `np_random`

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        seed_plant(self, seed)
        return float32(self.env.one_cart.reset().observation), {}

    def step(self, action: np.int64) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period."""
        now = self.env.one_cart.step(int(action))
        (reward,), (terminated,), (truncated,) = now.reward, now.terminated, now.truncated
        scores = {"score": now.score[0], "score_upright": now.score_upright[0]}
        return float32(now.observation), reward, terminated, truncated, scores


class CartPoleVector(VectorEnv[Array, Array, Array]):
    """Many simulated carts at once; a cart whose episode ends starts the next in the same step.

    `info` then holds the last observation under `final_obs`, as in Gymnasium's own vector environments.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        randomization: Randomization = "none",
        compiled: bool = False,
        render_mode: None = None,
    ) -> None:
        self.env = simulated_environment(task, num_envs, randomization, compiled)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.seeded = False  # the plant, from `np_random`
        self._present: TensorDictBase

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode on each cart; one seed serves all."""
        super().reset(seed=seed)
        seed_plant(self, seed)
        self._present = self.env.reset()
        return self._present["observation"].numpy().copy(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One control period of every cart."""
        self._present.set("action", torch.as_tensor(np.asarray(actions, dtype=np.int64)))
        transition, self._present = self.env.step_and_maybe_reset(self._present)
        last = {key: value.numpy() for key, value in transition["next"].items()}
        return (
            self._present["observation"].numpy().copy(),
            last["reward"][:, 0],
            last["terminated"][:, 0],
            last["truncated"][:, 0],
            vector_info(last),
        )


def vector_info(last: Mapping[str, Array]) -> dict[str, Any]:
    """Return the scores of all carts and the final observations of those that ended, each with its mask."""
    ended = last["done"][:, 0]
    everyone = np.ones_like(ended)
    scores = {key: last[key][:, 0] for key in SCORES}
    info: dict[str, Any] = {**scores, **{f"_{key}": everyone for key in SCORES}}
    if ended.any():
        final = np.full(len(ended), None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = last["observation"][row]
        info |= {"final_obs": final, "_final_obs": ended}
        info |= {"final_info": {**scores, **{f"_{key}": ended for key in SCORES}}, "_final_info": ended}
    return info


def float32(numbers: Sequence[float]) -> Array:
    """Return numbers as an array of float32."""
    return np.array(numbers, np.float32)


def seed_plant(wrapper: CartPoleGymnasium | CartPoleVector, seed: int | None) -> None:
    """Before the first episodes and those after a new `seed`, seed the plant's generator from Gymnasium's."""
    if seed is not None or not wrapper.seeded:
        wrapper.env.set_seed(int(wrapper.np_random.integers(2**31)))
        wrapper.seeded = True
