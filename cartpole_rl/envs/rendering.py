"""Pictures of simulated carts while they are driven: the `render_mode` of the Gymnasium environments.

"rgb_array" returns a picture of each cart, "human" shows the first carts in a window in real time. The
pictures are those of the animations; the arrow is the motor value of the period that has just ended.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw

from cartpole_rl.drawing.cart import FINER, CartDrawing, Course
from cartpole_rl.drawing.window import Window
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import Plant

RENDER_MODES = ("human", "rgb_array")
SHOWN = 9  # carts in a window, at most

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
