"""Episodes as animated GIFs in real time, small enough for a page or TensorBoard; also as MP4, also in pairs.

All frames share a fixed palette of at most 32 colours, so that a frame stores only the pixels that changed.
"""

import io
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageSequence

from cartpole_rl.drawing.cart import FINER, SIZE, CartDrawing, Course, palette
from cartpole_rl.files import replacing
from cartpole_rl.reporting.texts import ending_text
from cartpole_rl.tasks.episode import Ending, Episode

EVERY = 2  # control periods between frames, at least: 25 frames a second at 50 Hz
LAST_FRAME = 1000  # ms, of the last frame before the animation repeats
SHORTEST = 20  # ms; browsers slow down a frame that claims less
MILLISECOND = Fraction(1, 1000)  # s

Pair = tuple[Episode, Episode]


def write_animation(path: Path, pictures: Sequence[Image.Image], times: Sequence[int], mp4: bool) -> None:
    """Write pictures, each shown for its time (ms), as the GIF `path` and, if `mp4`, as an MP4 beside it.

    Creates the folder. An MP4 needs PyAV.
    """
    with replacing(path) as beside:
        beside.write_bytes(encoded_gif(pictures, times))
    if mp4:
        with replacing(path.with_suffix(".mp4")) as beside:
            beside.write_bytes(encoded_mp4(pictures, times))


def gif(episode: Episode, pole_length: float, track_half_length: float) -> bytes:
    """Return the episode as the bytes of an endless GIF in real time that pauses on its last frame.

    `pole_length` (pivot to tip) and `track_half_length` in m; an episode that knows its own pole shows that.
    """
    return encoded_gif([*frames(episode, pole_length, track_half_length)], durations(episode))


def frames(
    episode: Episode, pole_length: float, track_half_length: float, title: str = ""
) -> Iterator[Image.Image]:
    """Yield pictures of 480 by 320 pixels in the fixed palette; arguments as for `gif`."""
    drawing = drawn(episode, pole_length, track_half_length)
    background = drawing.background(title)
    for row in rows(episode):
        yield picture(drawing, background, row)


def drawn(
    episode: Episode, pole_length: float, track_half_length: float, duration: float | None = None
) -> CartDrawing:
    """Return the drawing of an episode; its time bar spans `duration` s, or the episode."""
    ending = "" if episode.ended_by == Ending.TIME else ending_text(episode)
    course = Course(episode.time, episode.x, episode.theta, episode.motor, episode.score)
    return CartDrawing.of(course, episode.pole_length or pole_length, track_half_length, duration, ending)


def picture(drawing: CartDrawing, background: Image.Image, row: int) -> Image.Image:
    """Return the picture of one row of the state, in the fixed palette."""
    canvas = background.copy()
    drawing.draw(ImageDraw.Draw(canvas), row)
    return canvas.reduce(FINER).quantize(palette=palette(), dither=Image.Dither.NONE)


def rows(episode: Episode) -> list[int]:
    """Return the rows of the state that become frames, SHORTEST or more apart, and the last."""
    period = max(1000 * float(np.median(np.diff(episode.time))), 1.0)  # ms; 0 where the link was lost at once
    every = max(EVERY, math.ceil(round(SHORTEST / period, 1)))
    chosen = list(range(0, episode.steps + 1, every))
    return chosen if chosen[-1] == episode.steps else [*chosen, episode.steps]


def durations(episode: Episode) -> list[int]:
    """Return the duration of each frame (ms): real time in the GIF's unit of 10 ms, rounded without drift."""
    hundredths = np.rint(100 * episode.time[rows(episode)]).astype(int)
    return [max(10 * int(wait), SHORTEST) for wait in np.diff(hundredths)] + [LAST_FRAME]


def side_by_side(
    episodes: Pair, titles: tuple[str, str], pole_length: float, track_half_length: float
) -> tuple[list[Image.Image], list[int]]:
    """Return pictures of 960 by 320 pixels and the time of each (ms); both episodes start together.

    After the end of the shorter episode its last picture stays. Lengths in m, as for `gif`.
    """
    longer = max(episodes, key=lambda episode: episode.time[-1])
    duration = float(longer.time[-1])
    halves = [drawn(episode, pole_length, track_half_length, duration) for episode in episodes]
    backgrounds = [half.background(title) for half, title in zip(halves, titles, strict=True)]
    pictures = []
    for time in longer.time[rows(longer)]:
        nearest = (int(np.abs(episode.time - time).argmin()) for episode in episodes)
        parts = [picture(*each) for each in zip(halves, backgrounds, nearest, strict=True)]
        pictures.append(joined(*parts))
    return pictures, durations(longer)


def joined(left: Image.Image, right: Image.Image) -> Image.Image:
    """Return two pictures in the fixed palette as one, with a line between them."""
    width, height = SIZE
    both = Image.new("P", (2 * width, height))
    both.putpalette(palette().getpalette() or [])
    both.paste(left, (0, 0))
    both.paste(right, (width, 0))
    ImageDraw.Draw(both).line((width, 20, width, height - 20), fill=1)  # ink
    return both


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
    return encoded_gif(chosen, times)


def encoded_gif(pictures: Sequence[Image.Image], times: Sequence[int]) -> bytes:
    """Return pictures in the fixed palette as an endless GIF, each shown for its time (ms)."""
    first, *others = pictures
    buffer = io.BytesIO()
    looks: dict[str, Any] = {"duration": [*times], "loop": 0, "optimize": False, "disposal": 1}
    first.save(buffer, "GIF", save_all=True, append_images=others, **looks)
    return buffer.getvalue()


def encoded_mp4(pictures: Sequence[Image.Image], times: Sequence[int]) -> bytes:
    """Return pictures as an MP4 (H.264), each shown for its time (ms)."""
    import av  # an extra

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", options={"crf": "18"})
        stream.width, stream.height = pictures[0].size
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", MILLISECOND
        starts = accumulate(times, initial=0)
        for picture, start in zip([*pictures, pictures[-1]], starts, strict=True):  # the last one ends then
            frame = av.VideoFrame.from_image(picture.convert("RGB"))
            frame.pts, frame.time_base = start, MILLISECOND
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return buffer.getvalue()
