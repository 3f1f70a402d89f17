"""The simulated environments for Gymnasium: one cart, or many at once.

    gymnasium.make("cartpole_rl/SwingUp-v0", render_mode="human")
    gymnasium.make_vec("cartpole_rl/Balance-v0", num_envs=1024, vectorization_mode="vector_entry_point")

Both wrap the same `CartPoleEnv` as everything else, with the nominal cart and the medium pole of conf/.
Keyword arguments take what the configuration takes, with the same checks: the name of a choice, a file of
yours or a mapping.

    gymnasium.make("cartpole_rl/SwingUp-v0", pole="large", observation="raw", cart="mine.yaml", period=0.01)
    gymnasium.make("cartpole_rl/SwingUp-v0", reward={"defaults": ["score"], "scale": 1.0}, guard="none")

In several processes, they start soonest if they are forked; TorchRL makes others start from nothing:

    gymnasium.make_vec("cartpole_rl/SwingUp-v0", 4, "async", vector_kwargs={"context": "fork"})

The keyword arguments are `pole`, `reward`, `observation`, `actions`, `cart`, `cart_friction`,
`pole_friction`, `guard`, `randomization` ("none" by default) and `period`, s.

| id         | actions                       | reward                            | ends          |
|------------|-------------------------------|-----------------------------------|---------------|
| SwingUp-v0 | 9, conf/actions/nine_levels   | (6.2), as in conf/reward/score    | track         |
| Balance-v0 | left, none, right, as `three` | (6.1), as in conf/reward/position | track, 12 deg |

An action is an index of the motor values, from full left to full right. The track guard (envs/guard.py)
replaces them near the end of the track. An episode is truncated after `max_episode_steps`, by default 500
control periods. `info` has the step's scores (6.1) `score_upright` and (6.2) `score`.

The observation is a Box of float32. The space itself is unbounded, because a measured speed has no bound;
the table gives the bounds of each number of `observation="history"`, or the usual range. Times the unit, a
number is in SI units.

| index | observation                               | unit    | range                       |
|-------|-------------------------------------------|---------|-----------------------------|
| 0     | x, positive right, 0 in the middle        | 0.38 m  | -1 to 1, the track          |
| 1     | x_dot, mean of the last period            | 1 m/s   | unbounded, usually -1 to 1  |
| 2     | cos(theta), 1 upright                     | 1       | -1 to 1                     |
| 3     | sin(theta), positive right                | 1       | -1 to 1                     |
| 4     | theta_dot, mean of the last period        | 8 rad/s | unbounded, usually -1 to 1  |
| 5-7   | the last three motor values, newest first | 255     | -1 to 1                     |
| 8     | x_dot a period ago                        | 1 m/s   | as 1                        |
| 9     | theta_dot a period ago                    | 8 rad/s | as 4                        |

`render_mode="rgb_array"` returns pictures of 320 by 480 pixels, one for each cart. `render_mode="human"`
shows up to nine carts in a window of matplotlib, in real time (envs/rendering.py); it needs a display.
A pickle holds the arguments: a copy starts anew, as with Gymnasium's own environments.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from cartpole_rl import MAX_EPISODE_STEPS
from cartpole_rl.checking import nearest_choice
from cartpole_rl.choices import choice
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.scheduling import no_garbage_collection
from cartpole_rl.terminal import waiting

with waiting("starting"), no_garbage_collection():  # PyTorch and TorchRL take seconds to import
    from cartpole_rl.envs.build import shipped_settings, simulated_env, with_fitted_guard
    from cartpole_rl.envs.cart_pole_env import CartPoleEnv
    from cartpole_rl.envs.rendering import RENDER_MODES, Picture, Renderer, has_display

OF_TASK = {
    "swingup": {"task": "swingup", "actions": "nine_levels", "reward": "score"},
    "balance": {"task": "balance", "actions": "three", "reward": "position"},
}
SCORES = ("score", "score_upright")
PERIOD = 0.02  # s, the control period of conf/train.yaml
OF_GYMNASIUM = {"time_limit": "max_episode_steps", "carts": "num_envs of gymnasium.make_vec"}
UNLIMITED = 2**62  # control periods, where Gymnasium's TimeLimit ends the episode
METADATA = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / PERIOD)}
TAKEN = (
    *(name for name in CartPoleSettings.model_fields if name not in ("task", "control_period")),
    "period",
)

Array = NDArray[Any]
Randomization = str | Mapping[str, Mapping[str, Any]]


@waiting("preparing: fitting the track guard")
def simulated_environment(
    task: str,
    carts: int,
    randomization: Randomization = "none",
    compiled: bool = False,
    time_limit: int | None = None,
    **choices: Any,
) -> CartPoleEnv:
    """Return the environment of `task`, "swingup" or "balance", with the other choices of conf/train.yaml.

    `randomization` is the name of a file in conf/randomization/, or its lines; `choices` are the other
    settings, see `environment_settings`. `time_limit` in control periods; None is that of the task. Raises
    ConfigError.
    """
    check_count("num_envs", carts)
    settings = environment_settings(task, {"randomization": randomization, **choices})
    if time_limit is not None:
        check_count("max_episode_steps", time_limit)
        fitted = with_fitted_guard(settings)  # before the change, so that environments share the fit
        limited = fitted.task.model_copy(update={"time_limit": time_limit})
        settings = fitted.model_copy(update={"task": limited})
    plant = SimulatedSettings(**choice("plant/simulated"))
    return simulated_env(settings, plant, carts, settings.task.start, seed=0, compiled=compiled)


def environment_settings(task: str, choices: Mapping[str, Any]) -> CartPoleSettings:
    """Return the settings of the environment of `task`, with `choices` as in `composition.compose`.

    `period`, s, is `control_period`. Raises ConfigError for a setting of anything but the environment.
    """
    if task not in OF_TASK:
        raise ConfigError(f"task={task}: {nearest_choice(str(task), [*OF_TASK])}")
    if unknown := [name for name in choices if name.partition(".")[0] not in TAKEN]:
        raise ConfigError(
            f"{unknown[0]}: an environment has no such setting; {nearest_choice(unknown[0], TAKEN)}"
        )
    named = {"control_period" if name == "period" else name: value for name, value in choices.items()}
    return shipped_settings({**OF_TASK[task], "pole": "medium", **named})


def check_count(name: str, value: Any) -> None:
    """Raise ConfigError if `value` is not an integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ConfigError(f"{name}={value}: give an integer of at least 1")


def checked_actions(actions: Any, space: spaces.Space[Any], number: int) -> Array:
    """Return the actions of `space`, indices of `number` motor values. Raises ConfigError for others."""
    given = np.asarray(actions)
    fits = given.shape == space.shape and given.dtype.kind in "iu"
    if not fits or (given < 0).any() or (given >= number).any():
        wrong = given.tolist() if given.size < 10 else f"{given.dtype} {list(given.shape)}"
        what = f"{space.shape[0]} integers" if space.shape else "an integer"
        raise ConfigError(f"action {wrong}: give {what} from 0 to {number - 1}")
    return given.astype(np.int64)


class Carts:
    """Base of the environments of one cart and of many: the simulated carts `env` and their pictures."""

    env: CartPoleEnv
    renderer: Renderer | None = None
    seeded = False  # the plant, from Gymnasium's generator

    def make_carts(
        self: Any, task: str, carts: int, mode: str | None, period: float, limit: int | None, /, **given: Any
    ) -> None:
        """Make the carts, with episodes of `limit` periods, and what draws them. Raises ConfigError."""
        for name, instead in OF_GYMNASIUM.items():
            if name in given:
                raise ConfigError(f"{name}: give {instead} instead")
        self.env = simulated_environment(task, carts, period=period, time_limit=limit, **given)
        modes = [each for each in RENDER_MODES if each != "human" or has_display()]
        period = self.env.plant.period
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": round(1 / period)}
        self.render_mode = mode
        if mode is not None:
            steps = MAX_EPISODE_STEPS if limit in (None, UNLIMITED) else limit
            self.renderer = Renderer(mode, self.env.plant, f"cartpole_rl {task}", period, steps)

    def spaces_of_one(self) -> tuple[spaces.Box, spaces.Discrete]:
        """Return the spaces of one cart: its observation, and an action as an index of its motor values."""
        hardware = self.env.hardware
        shape = (hardware.observation_settings.size,)
        return spaces.Box(-np.inf, np.inf, shape, np.float32), spaces.Discrete(len(hardware.motors))

    def seed_plant(self: Any, seed: int | None) -> None:
        """Seed the plant from Gymnasium's generator: before the first episodes, and for a new `seed`."""
        if seed is not None or not self.seeded:
            self.env.set_seed(int(self.np_random.integers(2**31)))
            self.seeded = True

    def drawn(self: Any) -> tuple[Picture, ...]:
        """Return the newest picture of each cart; none without a renderer, or if a window shows them."""
        return () if self.render_mode in (None, "human") else self.renderer.pictures()

    def close_window(self) -> None:
        """Close the window, if there is one."""
        if self.renderer is not None:
            self.renderer.close()


class CartPoleGymnasium(Carts, gymnasium.Env[Array, np.int64], EzPickle):
    """One simulated cart. It has no time limit; `gymnasium.make` adds the registered one.

    `choices` are the settings named above, as keyword arguments. Raises ConfigError.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str,
        randomization: Randomization = "none",
        render_mode: str | None = None,
        period: float = PERIOD,
        **choices: Any,
    ) -> None:
        EzPickle.__init__(self, task, randomization, render_mode, period, **choices)
        self.make_carts(task, 1, render_mode, period, UNLIMITED, randomization=randomization, **choices)
        self.observation_space, self.action_space = self.spaces_of_one()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        self.seed_plant(seed)
        first = self.env.one_cart.reset()
        if self.renderer is not None:
            x, _, theta, _ = first.state
            self.renderer.start(0, x, theta)
            self.renderer.show()
        return float32(first.observation), {}

    def step(self, action: np.int64) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period. Raises ConfigError for an unknown action, ResetNeeded before `reset`."""
        if not hasattr(self.env.one_cart, "percept"):
            raise ResetNeeded("call reset() before step()")
        now = self.env.one_cart.step(
            int(checked_actions(action, self.action_space, len(self.env.hardware.motors)))
        )
        (reward,), (terminated,), (truncated,) = now.reward, now.terminated, now.truncated
        scores = {"score": now.score[0], "score_upright": now.score_upright[0]}
        if self.renderer is not None:
            x, _, theta, _ = now.state
            self.renderer.advance(0, x, theta, self.env.one_cart.sent, now.score[0])
            self.renderer.show()
        return float32(now.observation), reward, terminated, truncated, scores

    def render(self) -> Picture | None:
        """Return the newest picture, uint8 [320, 480, 3]; None if it is shown in a window."""
        return next(iter(self.drawn()), None)

    def close(self) -> None:
        """Close the window."""
        self.close_window()


def float32(numbers: Sequence[float]) -> Array:
    """Return numbers as an array of float32."""
    return np.array(numbers, np.float32)
