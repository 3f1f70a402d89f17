"""One episode as an animated GIF in real time, small enough for a page, a pull request or TensorBoard.

All frames share a fixed palette of at most 32 colours, so that a frame stores only the pixels that changed.
"""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageSequence

from cartpole_rl.drawing.cart import FINER, CartDrawing, palette
from cartpole_rl.files import replacing
from cartpole_rl.reporting.words import ending_text
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode

EVERY = 2  # control periods between frames: 25 frames a second at 50 Hz
LAST_FRAME = 1000  # ms, of the last frame before the animation repeats
SHORTEST = 20  # ms; browsers slow down a frame that claims less


def write_gif(
    episode: Episode,
    path: Path | str,
    pole_length: float,
    track_half_length: float,
    title: str = "",
    every: int = EVERY,
) -> Path:
    """Write the animation of `gif` to `path`, and create its folder."""
    path = Path(path)
    with replacing(path) as beside:
        beside.write_bytes(gif(episode, pole_length, track_half_length, title, every))
    return path


def gif(
    episode: Episode, pole_length: float, track_half_length: float, title: str = "", every: int = EVERY
) -> bytes:
    """Return the episode as the bytes of an endless GIF in real time that pauses on its last frame.

    `pole_length` (pivot to tip) and `track_half_length` in m; one frame for each `every` control periods.
    """
    return _encoded(
        [*frames(episode, pole_length, track_half_length, title, every)], durations(episode, every)
    )


def frames(
    episode: Episode, pole_length: float, track_half_length: float, title: str = "", every: int = EVERY
) -> Iterator[Image.Image]:
    """Yield pictures of 480 by 320 pixels in the fixed palette; arguments as for `gif`."""
    ending = "" if episode.ended_by == Ending.TIME else ending_text(episode)
    drawing = CartDrawing.of(episode, pole_length, track_half_length, ending=ending)
    background = drawing.background(title)
    for row in rows(episode, every):
        canvas = background.copy()
        drawing.draw(ImageDraw.Draw(canvas), row)
        yield canvas.reduce(FINER).quantize(palette=palette(), dither=Image.Dither.NONE)


def rows(episode: Episode, every: int = EVERY) -> list[int]:
    """Return the rows of the state that become frames: each `every`-th, and the last."""
    chosen = list(range(0, episode.steps + 1, every))
    return chosen if chosen[-1] == episode.steps else [*chosen, episode.steps]


def durations(episode: Episode, every: int = EVERY) -> list[int]:
    """Return the duration of each frame (ms): real time in the GIF's unit of 10 ms, rounded without drift."""
    hundredths = np.rint(100 * episode.time[rows(episode, every)]).astype(int)
    return [max(10 * int(wait), SHORTEST) for wait in np.diff(hundredths)] + [LAST_FRAME]


def smaller(path: Path, width: int, every: int) -> bytes:
    """Return the GIF at `path` scaled to `width` pixels with each `every`-th frame, in the same time.

    Raises OSError for a file that is no picture.
    """
    chosen: list[Image.Image] = []
    times: list[int] = []
    with Image.open(path) as source:
        size = (width, round(width * source.height / source.width))
        for number, frame in enumerate(ImageSequence.Iterator(source)):
            if number % every == 0:
                scaled = frame.convert("RGB").resize(size, Image.Resampling.LANCZOS)
                chosen.append(scaled.quantize(palette=palette(), dither=Image.Dither.NONE))
                times.append(0)
            times[-1] += frame.info.get("duration", SHORTEST)
    return _encoded(chosen, times)


def _encoded(pictures: Sequence[Image.Image], times: Sequence[int]) -> bytes:
    """Return pictures in the fixed palette as an endless GIF, each shown for its time (ms)."""
    first, *others = pictures
    buffer = io.BytesIO()
    first.save(
        buffer,
        "GIF",
        save_all=True,
        append_images=others,
        duration=[*times],
        loop=0,
        optimize=False,
        disposal=1,
    )
    return buffer.getvalue()
