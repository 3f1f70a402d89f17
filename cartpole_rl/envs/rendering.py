"""Pictures of simulated carts while they are driven: the `render_mode` of the Gymnasium environments.

"rgb_array" returns a picture of each cart, "human" shows the first carts in a window in real time. The
pictures are those of the animations; the arrow is the motor value of the period that has just ended.
"""

import math
import os
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw

from cartpole_rl.drawing.cart import FINER, CartDrawing, Course
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import Plant

if TYPE_CHECKING:  # matplotlib is slow to import
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

RENDER_MODES = ("human", "rgb_array")
SHOWN = 9  # carts in a window, at most
DPI = 100.0
NO_WINDOW = (
    "a window needs a display and a toolkit, and matplotlib found only {backend!r}: install one, such as "
    "tkinter or PyQt6, or take pictures with render_mode=rgb_array"
)

Picture = NDArray[np.uint8]  # [320, 480, 3]


@dataclass
class EpisodeSoFar:
    """The part of an episode that has been driven; each list has a number for each row of the state."""

    xs: list[float]  # m
    thetas: list[float]  # rad
    motors: list[int] = field(default_factory=lambda: [0])  # of the period before the row
    scores: list[float] = field(default_factory=lambda: [0.0])

    def picture(self, pole_length: float, track_half_length: float, period: float, steps: int) -> Picture:
        """Return the newest state; lengths in m, the time bar spans `steps` periods of `period` s."""
        time = np.linspace(0.0, period * (len(self.xs) - 1), len(self.xs))
        motion = np.array(self.xs), np.array(self.thetas), np.array(self.motors)
        course = Course(time, *motion, np.array(self.scores[1:]))
        drawing = CartDrawing.of(course, pole_length, track_half_length, duration=steps * period)
        canvas = drawing.background("")
        drawing.draw(ImageDraw.Draw(canvas), len(self.xs) - 1)
        return np.asarray(canvas.reduce(FINER))


def has_display() -> bool:
    """Return whether this computer has a display that a window could be shown on."""
    return not sys.platform.startswith("linux") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


class Window:
    """A window, opened by the first picture; a picture stays for at least `period` s.

    Once the user has closed it, pictures are dropped.
    """

    def __init__(self, title: str, period: float) -> None:
        self._title, self._period = title, period
        self._figure: Figure | None = None
        self._image: AxesImage | None = None
        self._due = 0.0

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture [height, width, 3]. Raises ConfigError where no window can be opened."""
        from matplotlib import pyplot

        if self._figure is None or self._image is None:
            self._figure, self._image = self._opened(picture)
        if not pyplot.fignum_exists(self._figure.number):
            return
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()
        now = time.monotonic()
        time.sleep(max(0.0, self._due - now))
        self._due = max(self._due, now) + self._period

    def close(self) -> None:
        """Close the window if it is open."""
        if self._figure is not None:
            from matplotlib import pyplot

            pyplot.close(self._figure)

    def _opened(self, picture: NDArray[np.uint8]) -> "tuple[Figure, AxesImage]":
        """Open the window with the size of `picture`; return its figure and image."""
        from matplotlib import pyplot

        height, width = picture.shape[:2]
        figure = pyplot.figure(self._title, (width / DPI, height / DPI), DPI, clear=True)
        if figure.canvas.required_interactive_framework is None:
            pyplot.close(figure)
            raise ConfigError(NO_WINDOW.format(backend=pyplot.get_backend()))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        image = axes.imshow(picture)
        figure.show()
        return figure, image


class Renderer:
    """Pictures of N carts. Raises ConfigError for a mode that does not exist."""

    def __init__(self, mode: str, plant: Plant, title: str, period: float, steps: int) -> None:
        if mode not in RENDER_MODES:
            raise ConfigError(f"render_mode={mode!r}: choose from {', '.join(RENDER_MODES)}, or None")
        self._plant, self._period, self._steps = plant, period, steps
        self._episodes: dict[int, EpisodeSoFar] = {}
        self._window = Window(title, period) if mode == "human" else None

    def start(self, cart: int, x: float, theta: float) -> None:
        """Start an episode of a cart; x in m, theta in rad, as measured."""
        self._episodes[cart] = EpisodeSoFar([x], [theta])

    def advance(self, cart: int, x: float, theta: float, motor: int, score: float) -> None:
        """Add a period of a cart, driven with the motor value `motor`; `score` is its (6.2)."""
        episode = self._episodes[cart]
        episode.xs.append(x)
        episode.thetas.append(theta)
        episode.motors.append(motor)
        episode.scores.append(score)

    def show(self) -> None:
        """Show the newest state of the first carts in the window, if there is one. Raises ConfigError."""
        if self._window is not None:
            self._window.show(tiled(self.pictures(SHOWN)))

    def pictures(self, most: int | None = None) -> tuple[Picture, ...]:
        """Return a picture of the newest state of each cart, or of the first `most`."""
        lengths = self._plant.pole_length.tolist()
        tracks = self._plant.track_half_length.tolist()
        chosen = sorted(self._episodes)[:most]
        return tuple(
            self._episodes[cart].picture(lengths[cart], tracks[cart], self._period, self._steps)
            for cart in chosen
        )

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()


def tiled(pictures: tuple[Picture, ...]) -> Picture:
    """Return pictures of one size side by side, in about as many rows as columns; the rest is white."""
    columns = math.ceil(math.sqrt(len(pictures)))
    blank = np.full_like(pictures[0], 255)
    padded = [*pictures, *[blank] * (-len(pictures) % columns)]
    rows = [
        np.concatenate(padded[start : start + columns], axis=1) for start in range(0, len(padded), columns)
    ]
    return np.concatenate(rows)
