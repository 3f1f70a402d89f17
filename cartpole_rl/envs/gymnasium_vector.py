"""Many simulated carts at once for Gymnasium, with the actions and observations of `gymnasium.py`."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase

from cartpole_rl.envs.gymnasium import METADATA, PERIOD, SCORES, Array, Carts, Randomization, checked_actions
from cartpole_rl.envs.rendering import Picture, Renderer
from cartpole_rl.errors import ConfigError


class CartPoleVector(Carts, VectorEnv[Array, Array, Array], EzPickle):
    """Many simulated carts at once; a cart whose episode ends starts the next in the same step.

    `info` then holds the last observation under `final_obs`, as in Gymnasium's own vector environments.
    `choices` are the settings named in `gymnasium.py`. Raises ConfigError.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        randomization: Randomization = "none",
        compiled: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        period: float = PERIOD,
        **choices: Any,
    ) -> None:
        arguments = task, num_envs, randomization, compiled, render_mode, max_episode_steps, period
        EzPickle.__init__(self, *arguments, **choices)
        choices = {**choices, "randomization": randomization, "compiled": compiled}
        self.make_carts(task, num_envs, render_mode, period, max_episode_steps, **choices)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = self.spaces_of_one()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._present: TensorDictBase | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode on each cart, or on those of the `reset_mask` in `options`, bool [num_envs].

        One seed serves all. Raises ConfigError for several, or for another mask.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise ConfigError(f"seed={seed}: give one integer, which seeds all carts")
        super().reset(seed=seed)
        self.seed_plant(seed)
        mask = (options or {}).get("reset_mask")
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.dtype != bool or chosen.shape != (self.num_envs,) or not chosen.any():
            raise ConfigError(f"reset_mask: give {self.num_envs} booleans, of which one is True at least")
        if self._present is None or chosen.all():
            chosen, self._present = np.ones_like(chosen), self.env.reset()
        else:
            rows = torch.as_tensor(chosen).unsqueeze(1)
            self._present = self.env.reset(self._present.set("_reset", rows))
        if self.renderer is not None:
            start_all(self.renderer, self._present, np.flatnonzero(chosen).tolist())
            self.renderer.show()
        return self._present["observation"].numpy().copy(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One control period of every cart. Raises ConfigError for an action that does not exist."""
        if self._present is None:
            raise ResetNeeded("call reset() before step()")
        chosen = checked_actions(actions, self.action_space, len(self.env.hardware.motors))
        self._present.set("action", torch.as_tensor(chosen))
        transition, self._present = self.env.step_and_maybe_reset(self._present)
        if self.renderer is not None:
            self._draw(self.renderer, transition)
        last = {key: value.numpy() for key, value in transition["next"].items()}
        return (
            self._present["observation"].numpy().copy(),
            last["reward"][:, 0],
            last["terminated"][:, 0],
            last["truncated"][:, 0],
            vector_info(last),
        )

    def render(self) -> tuple[Picture, ...] | None:
        """Return the newest picture of each cart, uint8 [320, 480, 3]; None if they are shown in a window."""
        return self.drawn() or None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        self.close_window()

    def _draw(self, renderer: Renderer, transition: TensorDictBase) -> None:
        """Show the carts after a step; those whose episode ended show the start of the next."""
        motors = self.env.hardware.command(transition)["motor"]
        last = transition["next"]
        rows = torch.cat((last["state"], motors, last["score"]), dim=1).tolist()
        for cart, (x, _, theta, _, motor, score) in enumerate(rows):
            renderer.advance(cart, x, theta, int(motor), score)
        start_all(renderer, self._present, last["done"][:, 0].nonzero()[:, 0].tolist())
        renderer.show()


def start_all(renderer: Renderer, present: TensorDictBase, carts: Iterable[int]) -> None:
    """Start an episode of each of `carts` at its state in `present`."""
    states = present["state"].tolist()
    for cart in carts:
        x, _, theta, _ = states[cart]
        renderer.start(cart, x, theta)


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
