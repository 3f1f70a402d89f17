"""The GIF runs in real time, and its pictures show the cart where it was."""

import dataclasses
import io
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageChops, ImageColor

from cartpole_rl.drawing import colours
from cartpole_rl.drawing.cart import CART_WIDTH, PIVOT_HEIGHT, SIZE
from cartpole_rl.reporting.animation import LAST_FRAME, durations, frames, gif, side_by_side, write_animation
from cartpole_rl.tasks.episode import Episode, Origin

POLE, TRACK = 0.3365, 0.407  # m


def shown(data: bytes) -> Iterator[tuple[Image.Image, int]]:
    """Each picture of a GIF as RGB, and for how many ms it is shown."""
    with Image.open(io.BytesIO(data)) as picture:
        for index in range(picture.n_frames):
            picture.seek(index)
            yield picture.convert("RGB"), picture.info["duration"]


def places(picture: Image.Image, colour: str) -> np.ndarray:
    """Pixels [P, 2] (x, y) that have about this colour."""
    distance = np.abs(np.asarray(picture.convert("RGB")).astype(int) - ImageColor.getrgb(colour)).sum(-1)
    return np.argwhere(distance < 12)[:, ::-1]


def part(episode: Episode, start: int, steps: int, **other: object) -> Episode:
    """`steps` periods of an episode from row `start` on."""
    long = {"time", "x", "x_dot", "theta", "theta_dot", "counts"}
    values = {
        field.name: getattr(episode, field.name)[start : start + steps + (field.name in long)]
        for field in dataclasses.fields(episode)
        if isinstance(getattr(episode, field.name), np.ndarray)
    }
    return Episode(**{**values, "ended_by": episode.ended_by, **other})  # type: ignore[arg-type]


def first(episode: Episode) -> Image.Image:
    """The first picture of an episode."""
    return next(iter(frames(episode, POLE, TRACK)))


def test_ten_seconds_are_251_frames_of_real_time_and_a_rest(swing_up: Episode) -> None:
    animation = gif(swing_up, POLE, TRACK)
    assert len(animation) < 1_500_000
    with Image.open(io.BytesIO(animation)) as picture:
        assert picture.size == SIZE == (480, 320)
        assert picture.info["loop"] == 0
    pictures, waits = zip(*shown(animation), strict=True)
    assert waits == (*[40] * 250, LAST_FRAME)
    assert all(ImageChops.difference(one, after).getbbox() for one, after in pairwise(pictures))
    for index, expected in enumerate(frames(swing_up, POLE, TRACK)):
        if index % 50 == 0:
            assert ImageChops.difference(pictures[index], expected.convert("RGB")).getbbox() is None


@pytest.mark.parametrize("row", [0, 40, 90, 300])
def test_cart_and_pole_are_to_scale(swing_up: Episode, row: int) -> None:
    still = part(swing_up, row, 1, motor=np.zeros(1, dtype=np.int64))
    picture = first(still)
    stops = places(picture, colours.LIMIT)
    scale = (np.ptp(stops[:, 0]) - 2 * 5 - CART_WIDTH) / (2 * TRACK)  # pixels a metre
    cart = places(picture, colours.CART)
    cart = cart[np.abs(cart[:, 1] - PIVOT_HEIGHT) < 9]
    middle = (cart[:, 0].min() + cart[:, 0].max()) / 2
    assert middle == pytest.approx(SIZE[0] / 2 + swing_up.x[row] * scale, abs=2)
    pole = np.concatenate([places(picture, colour) for colour in (colours.POLE, colours.UPRIGHT)])
    pole = pole[pole[:, 1] < 292]  # above the bar
    reach = np.hypot(pole[:, 0] - middle, pole[:, 1] - PIVOT_HEIGHT)
    tip = pole[reach.argmax()]
    assert reach.max() == pytest.approx(POLE * scale, abs=5)
    direction = np.arctan2(tip[0] - middle, PIVOT_HEIGHT - tip[1])
    assert np.cos(direction - swing_up.theta[row]) > np.cos(0.06)


def test_the_arrow_points_where_the_motor_pushes_and_is_longer_for_a_stronger_push(balance: Episode) -> None:
    widths = {}
    for motor in (250, -250, 100):
        arrow = places(first(part(balance, 0, 1, motor=np.array([motor]))), colours.MOTOR)
        arrow = arrow[arrow[:, 1] < 200]  # without the legend
        assert np.all(np.sign(arrow[:, 0] - SIZE[0] / 2) == np.sign(motor))
        widths[motor] = np.ptp(arrow[:, 0])
    assert widths[250] - widths[100] == pytest.approx(150 / 255 * 70, abs=2)


def test_the_pole_is_that_of_the_episode_where_it_is_known(swing_up: Episode) -> None:
    known = dataclasses.replace(swing_up, origin=Origin({"pole_com": POLE / 2}, {}))
    assert next(frames(known, 2 * POLE, TRACK)) == first(swing_up)


@pytest.mark.parametrize("period", [0.02, 0.01, 0.008, 0.005, 0.001])
def test_any_control_period_is_shown_in_real_time(swing_up: Episode, period: float) -> None:
    waits = durations(dataclasses.replace(swing_up, time=swing_up.time / 0.02 * period))
    assert sum(waits[:-1]) == pytest.approx(500 * 1000 * period, abs=10)


def test_jitter_does_not_accumulate(balance: Episode) -> None:
    generator = np.random.default_rng(3)
    time = np.concatenate(([0.0], np.cumsum(generator.uniform(0.017, 0.0237, 500))))
    jittered = dataclasses.replace(balance, time=time)
    waits = durations(jittered)[:-1]
    assert sum(waits) == pytest.approx(1000 * time[-1], abs=10)
    assert all(wait % 10 == 0 for wait in waits)


def test_leaving_the_track_is_shown(runaway: Episode) -> None:
    *_, before, last = frames(part(runaway, runaway.steps - 4, 4), POLE, TRACK)
    header = (0, 36, 300, 56)
    assert len(places(last.crop(header), colours.LIMIT)) > 50
    assert len(places(before.crop(header), colours.LIMIT)) == 0


def written(episode: Episode, path: Path, mp4: bool = False) -> Path:
    """Write the animation of an episode."""
    write_animation(path, [*frames(episode, POLE, TRACK)], durations(episode), mp4)
    return path


def test_the_mp4_shows_the_same_pictures_for_as_long(tmp_path, swing_up: Episode) -> None:
    av = pytest.importorskip("av")
    path = written(part(swing_up, 0, 40), tmp_path / "episode.gif", mp4=True)
    with av.open(path.with_suffix(".mp4")) as video:
        filmed = list(video.decode(video=0))
    drawn = list(shown(path.read_bytes()))
    starts = np.cumsum([0, *(wait for _, wait in drawn)]) / 1000
    assert [frame.time for frame in filmed] == pytest.approx(list(starts))  # the last picture ends there
    for frame, (picture, _) in zip(filmed, drawn, strict=False):
        difference = np.asarray(frame.to_image()).astype(int) - np.asarray(picture)
        assert np.abs(difference).mean() < 3


def test_side_by_side_both_run_in_real_time_until_the_longer_one_ends(swing_up: Episode) -> None:
    short, long = part(swing_up, 0, 10), part(swing_up, 0, 40)
    left, right = list(frames(short, POLE, TRACK)), list(frames(long, POLE, TRACK))
    pictures, times = side_by_side((short, long), ("", ""), POLE, TRACK)
    assert times == durations(long)
    bar = 290  # the left time bar is as long as that of the longer episode
    for number, both in enumerate(pictures):
        halves = both.convert("RGB").crop((0, 0, 475, bar)), both.convert("RGB").crop((485, 0, 960, bar))
        for half, alone, place in zip(halves, (left, right), (0, 5), strict=True):
            expected = alone[min(number, len(alone) - 1)].convert("RGB").crop((place, 0, 475 + place, bar))
            assert ImageChops.difference(half, expected).getbbox() is None
