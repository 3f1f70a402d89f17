"""A window of matplotlib that shows pictures one after another in real time."""

import os
import sys
import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import ConfigError

if TYPE_CHECKING:  # matplotlib is slow to import
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

DPI = 100.0
NO_WINDOW = (
    "a window needs a display and a toolkit, and matplotlib found only {backend!r}: install one, such as "
    "tkinter or PyQt6, or take pictures with render_mode=rgb_array"
)


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
