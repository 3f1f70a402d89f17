"""A cart, its pole and its track as a Pillow picture, to scale.

Positions are those that the cart measured, x and theta positive to the right. Everything is drawn FINER times
larger and scaled down, which smooths the edges. Coordinates in this file are these fine pixels; constants are
in pixels of the result. Colours mean the same as in the figures.
"""

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from cartpole_rl.drawing import colours
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.tasks.episode import is_upright

SIZE = (480, 320)  # pixels
FINER = 2

MARGIN = 20  # pixels, left and right
PIVOT_HEIGHT = 172  # pixels from the top
REACH = 118  # pixels that the pole may take above and below the pivot
CART_WIDTH, CART_HEIGHT, WHEEL = 40, 20, 5  # pixels; only the cart is not to scale
LONGEST_ARROW = 70  # pixels, of the largest motor value
BAR = (294, 301)  # pixels from the top: the time bar
LEGEND = 311  # pixels from the top
TITLE_WIDTH = 270  # pixels; a longer title is cut
TRAIL = 0.4  # s for which the path of the pole's tip stays visible
FAINTEST = 0.15  # share of its colour at the far end

TINTS = {  # shares of each colour over white, for smooth edges; with white at most 32 colours
    colours.INK: (1.0, 0.8, 0.6, 0.42, 0.27, 0.13),
    colours.POLE: (1.0, 0.75, 0.5, 0.3, 0.15),
    colours.UPRIGHT: (1.0, 0.75, 0.5, 0.3, 0.15),
    colours.CART: (1.0, 0.8, 0.6, 0.4, 0.2),
    colours.MOTOR: (1.0, 0.75, 0.5, 0.25),
    colours.LIMIT: (1.0, 0.75, 0.5, 0.25),
}

Colour = tuple[int, int, int]
Draw = ImageDraw.ImageDraw


class Course(NamedTuple):
    """The part of an episode of T control periods that is drawn."""

    time: NDArray[np.float64]  # [T+1] s
    x: NDArray[np.float64]  # [T+1] m
    theta: NDArray[np.float64]  # [T+1] rad
    motor: NDArray[np.int64]  # [T] or [T+1] drawn at each row; 0 at the last row if it is missing
    score: NDArray[np.float64]  # [T] equation (6.2) of each step


@dataclass(frozen=True)
class CartDrawing:
    """One episode, ready to be drawn row by row."""

    episode: Course
    pole: float  # fine pixels
    track: float  # fine pixels, half length
    scale: float  # fine pixels per metre
    upright: NDArray[np.bool_]  # [T+1]
    score: NDArray[np.float64]  # [T+1] sum of equation (6.2) so far
    duration: float  # s, of the whole time bar
    ending: str  # written on the last row

    @classmethod
    def of(
        cls,
        episode: Course,
        pole_length: float,
        track_half_length: float,
        duration: float | None = None,
        ending: str = "",
    ) -> "CartDrawing":
        """Scale the drawing so that track and pole (lengths in m) just fit.

        The time bar spans `duration` s, or the episode.
        """
        width = SIZE[0] - 2 * MARGIN
        scale = FINER * min(REACH / pole_length, (width - 1.3 * CART_WIDTH) / (2 * track_half_length))
        return cls(
            episode,
            pole=pole_length * scale,
            track=track_half_length * scale,
            scale=scale,
            upright=is_upright(episode.theta),
            score=np.concatenate(([0.0], np.cumsum(episode.score))),
            duration=duration or float(episode.time[-1] - episode.time[0]) or 1.0,
            ending=ending,
        )

    def background(self, title: str) -> Image.Image:
        """Draw what never changes: title, track, stops and middle, the empty time bar, and the legend."""
        canvas = Image.new("RGB", (FINER * SIZE[0], FINER * SIZE[1]), colours.PAPER)
        draw = ImageDraw.Draw(canvas)
        self._draw_title(draw, title)
        self._draw_track(draw)
        draw.rectangle(_bar(0.0, 1.0), fill=tint(colours.INK, 0.13))
        _draw_legend(draw)
        return canvas

    def draw(self, draw: Draw, row: int) -> None:
        """Draw what moves, at `row` of the state."""
        self._draw_trail(draw, row)
        self._draw_arrow(draw, row)
        self._draw_cart(draw, row)
        self._draw_progress(draw, row)
        self._draw_numbers(draw, row)

    def _cart(self, row: int) -> tuple[float, float]:
        """Return the position of the pivot."""
        return FINER * SIZE[0] / 2 + self.episode.x[row] * self.scale, FINER * float(PIVOT_HEIGHT)

    def _tip(self, row: int) -> tuple[float, float]:
        x, y = self._cart(row)
        theta = self.episode.theta[row]
        return x + self.pole * math.sin(theta), y - self.pole * math.cos(theta)

    def _colour(self, row: int) -> str:
        """Return the pole's colour: green while it is upright."""
        return colours.UPRIGHT if self.upright[row] else colours.POLE

    def _draw_title(self, draw: Draw, title: str) -> None:
        font, whole = _font(15, bold=True), title
        while font.getlength(title) > FINER * TITLE_WIDTH:
            whole = whole[:-1].rstrip()
            title = whole + "…"
        draw.text((FINER * MARGIN, FINER * 24), title, fill=colours.INK, font=font, anchor="lm")

    def _draw_track(self, draw: Draw) -> None:
        """Draw the rail, its middle, and the stops that the cart touches at the track's ends."""
        middle, height, grey = FINER * SIZE[0] / 2, FINER * PIVOT_HEIGHT, tint(colours.INK, 0.42)
        end = self.track + FINER * CART_WIDTH / 2
        rail = height + FINER * (CART_HEIGHT / 2 + WHEEL)
        draw.rectangle((middle - end, rail, middle + end, rail + FINER * 3), fill=grey)
        for side in (-1, 1):
            inner, outer = middle + side * end, middle + side * (end + FINER * 5)
            box = (min(inner, outer), height - FINER * 12, max(inner, outer), rail + FINER * 3)
            draw.rectangle(box, fill=colours.LIMIT)
        draw.line((middle, rail + FINER * 5, middle, rail + FINER * 11), fill=grey, width=FINER * 2)

    def _draw_trail(self, draw: Draw, row: int) -> None:
        """Draw the fading path of the tip."""
        since = self.episode.time[row] - self.episode.time[: row + 1]
        for earlier in np.flatnonzero(since < TRAIL)[:-1]:
            part = FAINTEST + (0.5 - FAINTEST) * (1 - since[earlier] / TRAIL)
            points = (*self._tip(earlier), *self._tip(earlier + 1))
            draw.line(points, fill=tint(self._colour(earlier), part), width=FINER * 3)

    def _draw_arrow(self, draw: Draw, row: int) -> None:
        """Draw the motor value as an arrow on the side towards which it pushes."""
        motor = int(self.episode.motor[row]) if row < len(self.episode.motor) else 0
        if motor == 0:
            return
        x, y = self._cart(row)
        side = math.copysign(1, motor)
        head = FINER * 9.0
        start = x + side * FINER * (CART_WIDTH / 2 + 4)
        end = start + side * (FINER * LONGEST_ARROW * abs(motor) / LARGEST_MOTOR + head)
        draw.line((start, y, end - side * head, y), fill=colours.MOTOR, width=FINER * 6)
        draw.polygon(
            [(end, y), (end - side * head, y - head), (end - side * head, y + head)], fill=colours.MOTOR
        )

    def _draw_cart(self, draw: Draw, row: int) -> None:
        x, y = self._cart(row)
        half_width, half_height = FINER * CART_WIDTH / 2, FINER * CART_HEIGHT / 2
        for side in (-0.55, 0.55):
            _disc(draw, x + side * half_width, y + half_height, FINER * WHEEL, colours.INK)
        box = (x - half_width, y - half_height, x + half_width, y + half_height)
        draw.rounded_rectangle(box, FINER * 4, fill=colours.CART)
        draw.line((x, y, *self._tip(row)), fill=self._colour(row), width=FINER * 7)
        _disc(draw, *self._tip(row), FINER * 3.4, self._colour(row))
        _disc(draw, x, y, FINER * 6.0, colours.INK)
        _disc(draw, x, y, FINER * 2.5, colours.PAPER)

    def _draw_progress(self, draw: Draw, row: int) -> None:
        """Fill the bar up to now, green where the pole was upright."""
        shares = (self.episode.time - self.episode.time[0]) / self.duration
        edges = [0, *(np.flatnonzero(np.diff(self.upright[: row + 1])) + 1), row]
        for start, stop in pairwise(edges):
            colour = colours.UPRIGHT if self.upright[start] else tint(colours.POLE, 0.5)
            draw.rectangle(_bar(shares[start], shares[stop]), fill=colour)

    def _draw_numbers(self, draw: Draw, row: int) -> None:
        """Write the time, the score so far and, on the last row, the ending."""
        right, font = FINER * (SIZE[0] - MARGIN), _font(15)
        clock = f"{self.episode.time[row] - self.episode.time[0]:.2f} s"
        draw.text((right, FINER * 24), clock, fill=colours.INK, font=font, anchor="rm")
        score = f"score {self.score[row]:z.0f}"
        draw.text((right - FINER * 75, FINER * 24), score, fill=colours.INK, font=font, anchor="rm")
        if self.ending and row == len(self.upright) - 1:
            place = (FINER * MARGIN, FINER * 46)
            draw.text(place, self.ending, fill=colours.LIMIT, font=font, anchor="lm")


def tint(colour: str, part: float) -> Colour:
    """Return the share `part` of a colour over white; 0 is white."""
    red, green, blue = (round(255 + part * (level - 255)) for level in ImageColor.getrgb(colour)[:3])
    return red, green, blue


@cache
def palette() -> Image.Image:
    """Return a picture whose palette has the fixed colours, as Pillow's `quantize` takes it."""
    tints = [tint(colours.INK, 0.0)] + [
        tint(colour, part) for colour, parts in TINTS.items() for part in parts
    ]
    holder = Image.new("P", (1, 1))
    holder.putpalette([level for each in tints for level in each])
    return holder


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return the typeface of the figures, which comes with matplotlib, at `size` pixels."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", name)), FINER * size)


def _bar(start: float, stop: float) -> tuple[float, float, float, float]:
    """Return the box of the time bar between two shares of the episode, 0 to 1."""
    left, width = FINER * MARGIN, FINER * (SIZE[0] - 2 * MARGIN)
    return left + start * width, FINER * BAR[0], left + stop * width, FINER * BAR[1]


def _draw_legend(draw: Draw) -> None:
    """Explain the bar's green and the arrow, below the bar."""
    font, height, grey = _font(10), FINER * LEGEND, tint(colours.INK, 0.6)
    left, right = FINER * MARGIN, FINER * (SIZE[0] - MARGIN)
    draw.text((left, height), "time, green while the pole is upright", fill=grey, font=font, anchor="lm")
    words = "motor"
    draw.text((right, height), words, fill=grey, font=font, anchor="rm")
    tip, head = right - font.getlength(words) - FINER * 5, FINER * 4
    draw.line((tip - FINER * 16, height, tip - head, height), fill=colours.MOTOR, width=FINER * 3)
    draw.polygon(
        [(tip, height), (tip - head, height - head), (tip - head, height + head)], fill=colours.MOTOR
    )


def _disc(draw: Draw, x: float, y: float, radius: float, colour: str) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
