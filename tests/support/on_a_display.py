"""Opens windows of the Gymnasium environments and checks them; run as a program, on a display.

Tk ends its process when the display goes away, so this is no part of a test's own process.
"""

import warnings

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env
from matplotlib import pyplot

from cartpole_rl.envs.rendering import tiled

SWING_UP = "cartpole_rl/SwingUp-v0"


def check_both_modes() -> None:
    """Let Gymnasium check an environment with every render mode."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity.*")  # a measured state has no bounds
        check_env(gymnasium.make(SWING_UP, render_mode="rgb_array").unwrapped)


def check_a_window_that_the_user_closes() -> None:
    """It shows the newest pictures; once closed it stays closed."""
    env = gymnasium.make_vec(SWING_UP, num_envs=3, render_mode="human")
    env.reset(seed=0)
    env.step(np.full(3, 8))
    assert env.render() is None
    (number,) = pyplot.get_fignums()
    shown = pyplot.figure(number).axes[0].images[0].get_array()
    assert (shown == tiled(env.renderer.pictures())).all()
    pyplot.close(number)
    env.step(np.full(3, 8))
    assert pyplot.get_fignums() == []
    env.close()


def check_a_window_that_the_environment_closes() -> None:
    """`close` closes it."""
    env = gymnasium.make(SWING_UP, render_mode="human")
    env.reset(seed=0)
    assert len(pyplot.get_fignums()) == 1
    env.close()
    assert pyplot.get_fignums() == []


if __name__ == "__main__":
    check_both_modes()
    check_a_window_that_the_user_closes()
    check_a_window_that_the_environment_closes()
    print("all windows are right")
