"""Two episodes side by side in one animation: a cart, and the prediction of simulation."""

from collections.abc import Iterator

import numpy as np
from PIL import Image, ImageDraw

from cartpole_rl.drawing.cart import SIZE, palette
from cartpole_rl.reporting.animation import drawn, durations, picture, rows
from cartpole_rl.tasks.episode import Episode

Pair = tuple[Episode, Episode]


def side_by_side(
    episodes: Pair, titles: tuple[str, str], pole_length: float, track_half_length: float
) -> tuple[list[Image.Image], list[int]]:
    """Return pictures of 960 by 320 pixels and the time of each (ms); both episodes start together.

    After the end of the shorter episode its last picture stays. Lengths in m, as for `animation.gif`.
    """
    longer = max(episodes, key=lambda episode: episode.time[-1])
    duration = float(longer.time[-1])
    halves = [drawn(episode, pole_length, track_half_length, duration) for episode in episodes]
    backgrounds = [half.background(title) for half, title in zip(halves, titles, strict=True)]
    pictures = []
    for pair in zip(*(nearest_rows(episode, longer) for episode in episodes), strict=True):
        parts = [picture(*each) for each in zip(halves, backgrounds, pair, strict=True)]
        pictures.append(joined(*parts))
    return pictures, durations(longer)


def nearest_rows(episode: Episode, longer: Episode) -> Iterator[int]:
    """Yield the row of `episode` nearest in time to each picture of `longer`."""
    for time in longer.time[rows(longer)]:
        yield int(np.abs(episode.time - time).argmin())


def joined(left: Image.Image, right: Image.Image) -> Image.Image:
    """Return two pictures in the fixed palette as one, with a line between them."""
    width, height = SIZE
    both = Image.new("P", (2 * width, height))
    both.putpalette(palette().getpalette() or [])
    both.paste(left, (0, 0))
    both.paste(right, (width, 0))
    ImageDraw.Draw(both).line((width, 20, width, height - 20), fill=1)  # ink
    return both
