"""Pictures and windows of the Gymnasium environments; the windows are on a display without a screen."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from matplotlib import pyplot
from PIL import ImageColor

from cartpole_rl.drawing import colours
from cartpole_rl.envs.gymnasium import CartPoleGymnasium
from cartpole_rl.envs.rendering import Picture, tiled
from cartpole_rl.errors import ConfigError

WINDOWS = Path(__file__).parents[1] / "support/on_a_display.py"
SWING_UP = "cartpole_rl/SwingUp-v0"


def pixels(picture: Picture, colour: str) -> np.ndarray:
    """The pixels [P, 2] (x, y) above the legend that have about this colour."""
    distance = np.abs(picture[:285].astype(int) - ImageColor.getrgb(colour)).sum(-1)
    return np.argwhere(distance < 12)[:, ::-1]


@pytest.fixture
def display() -> Iterator[str]:
    """The name of a display without a screen."""
    pytest.importorskip("tkinter", reason="a window needs tkinter")
    if shutil.which("Xvfb") is None:
        pytest.skip("a display without a screen needs Xvfb")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1600x1200x24"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().strip()}"
        server.terminate()


@pytest.mark.nightly
def test_windows_show_the_pictures_and_gymnasiums_checker_accepts_both_modes(display: str) -> None:
    environment = os.environ | {"DISPLAY": display, "MPLBACKEND": "TkAgg"}
    command = [sys.executable, str(WINDOWS)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "all windows are right\n", done.stderr


def test_a_picture_shows_where_the_cart_is_and_its_motor_value() -> None:
    env = gymnasium.make(SWING_UP, render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert (first.shape, first.dtype) == ((320, 480, 3), np.uint8)
    assert len(pixels(first, colours.MOTOR)) == 0
    for _ in range(6):
        observation = env.step(8)[0]  # full right
    picture = env.render()
    cart = pixels(picture, colours.CART)
    assert len(pixels(picture, colours.MOTOR)) > 100
    half = (480 - 2 * 20 - 1.3 * 40) / 2  # pixels, of the track
    middle = (cart[:, 0].min() + cart[:, 0].max()) / 2
    scale = min(118 / 0.3556, half / 0.38)  # pixels a metre
    assert middle == pytest.approx(240 + 0.38 * observation[0] * scale, abs=2)


def test_each_cart_of_a_vector_has_its_picture_and_restarts_with_its_episode() -> None:
    env = gymnasium.make_vec(SWING_UP, num_envs=3, render_mode="rgb_array", max_episode_steps=5)
    env.reset(seed=1)
    first = env.render()
    assert len(first) == 3
    assert len({picture.tobytes() for picture in first}) == 3
    right = np.full(3, 8)
    for _ in range(4):
        env.step(right)
    assert all(len(pixels(picture, colours.MOTOR)) > 100 for picture in env.render())
    env.step(right)  # the episodes end, and the next have started
    assert all(len(pixels(picture, colours.MOTOR)) == 0 for picture in env.render())


def test_where_no_window_can_be_opened_the_error_says_what_to_do() -> None:
    pyplot.switch_backend("agg")
    env = gymnasium.make(SWING_UP, render_mode="human")
    with pytest.raises(ConfigError, match=r"found only 'agg': install one, .* render_mode=rgb_array"):
        env.reset(seed=0)


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ConfigError, match="render_mode='ansi': choose from human, rgb_array, or None"):
        CartPoleGymnasium("swingup", render_mode="ansi")


def test_tiles_fill_the_rows_and_the_rest_is_white() -> None:
    pictures = tuple(np.full((2, 3, 3), level, np.uint8) for level in range(3))
    whole = tiled(pictures)
    assert whole.shape == (4, 6, 3)
    assert [whole[0, 0, 0], whole[0, 3, 0], whole[2, 0, 0], whole[2, 3, 0]] == [0, 1, 2, 255]
