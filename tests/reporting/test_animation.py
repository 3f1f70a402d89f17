"""The GIF runs in real time, and its pictures show the cart where it was."""

import dataclasses
import io
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageChops, ImageColor

from cartpole_rl.drawing.cart import CART_WIDTH, PIVOT_HEIGHT, SIZE
from cartpole_rl.reporting import style
from cartpole_rl.reporting.animation import LAST_FRAME, durations, frames, gif, rows, smaller, write_gif
from cartpole_rl.tasks.episode import Episode

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
        if field.name not in ("ended_by", "origin", "guarded", "expected")
    }
    return Episode(**{**values, "ended_by": episode.ended_by, **other})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def animation(swing_up: Episode) -> bytes:
    return gif(swing_up, POLE, TRACK, "Swing-up")


def test_ten_seconds_are_251_frames_of_real_time_and_a_rest(animation: bytes) -> None:
    waits = [wait for _, wait in shown(animation)]
    assert len(waits) == 251
    assert waits[:-1] == [40] * 250
    assert waits[-1] == LAST_FRAME


def test_it_is_small_loops_endlessly_and_has_the_stated_size(animation: bytes) -> None:
    assert len(animation) < 1_500_000
    with Image.open(io.BytesIO(animation)) as picture:
        assert picture.size == SIZE == (480, 320)
        assert picture.info["loop"] == 0


def test_every_frame_differs_from_the_one_before(animation: bytes) -> None:
    pictures = [picture for picture, _ in shown(animation)]
    assert all(ImageChops.difference(one, next_one).getbbox() for one, next_one in pairwise(pictures))


def test_the_file_holds_what_frames_draws(swing_up: Episode, animation: bytes) -> None:
    expected = list(frames(swing_up, POLE, TRACK, "Swing-up"))
    for index, (picture, _) in enumerate(shown(animation)):
        if index % 50 == 0:
            assert ImageChops.difference(picture, expected[index].convert("RGB")).getbbox() is None


@pytest.mark.parametrize("row", [0, 40, 90, 300])
def test_cart_and_pole_are_to_scale(swing_up: Episode, row: int) -> None:
    still = part(swing_up, row, 1, motor=np.zeros(1, dtype=np.int64))
    picture = next(iter(frames(still, POLE, TRACK)))
    stops = places(picture, style.LIMIT)
    scale = (np.ptp(stops[:, 0]) - 2 * 5 - CART_WIDTH) / (
        2 * TRACK
    )  # pixels a metre, from the expected stops
    cart = places(picture, style.CART)
    cart = cart[np.abs(cart[:, 1] - PIVOT_HEIGHT) < 9]
    middle = (cart[:, 0].min() + cart[:, 0].max()) / 2
    assert middle == pytest.approx(SIZE[0] / 2 + swing_up.x[row] * scale, abs=2)
    pole = np.concatenate([places(picture, colour) for colour in (style.POLE, style.UPRIGHT)])
    pole = pole[pole[:, 1] < 292]  # above the bar
    reach = np.hypot(pole[:, 0] - middle, pole[:, 1] - PIVOT_HEIGHT)
    tip = pole[reach.argmax()]
    assert reach.max() == pytest.approx(POLE * scale, abs=5)
    direction = np.arctan2(tip[0] - middle, PIVOT_HEIGHT - tip[1])
    assert np.cos(direction - swing_up.theta[row]) > np.cos(0.06)


@pytest.mark.parametrize(("motor", "side"), [(250, 1), (-250, -1), (100, 1)])
def test_the_arrow_points_where_the_motor_pushes(balance: Episode, motor: int, side: int) -> None:
    still = part(balance, 0, 1, motor=np.array([motor]))
    arrow = places(next(iter(frames(still, POLE, TRACK))), style.MOTOR)
    arrow = arrow[arrow[:, 1] < 200]  # without the legend
    assert np.all(np.sign(arrow[:, 0] - SIZE[0] / 2) == side)


def test_a_longer_arrow_is_a_stronger_push(balance: Episode) -> None:
    widths = []
    for motor in (100, 250):
        arrow = places(
            next(iter(frames(part(balance, 0, 1, motor=np.array([motor])), POLE, TRACK))), style.MOTOR
        )
        widths.append(np.ptp(arrow[arrow[:, 1] < 200][:, 0]))
    assert widths[1] - widths[0] == pytest.approx(150 / 255 * 70, abs=2)


def test_the_pole_turns_green_when_it_is_upright(swing_up: Episode) -> None:
    fallen, upright = (next(iter(frames(part(swing_up, row, 1), POLE, TRACK))) for row in (0, 400))
    assert len(places(upright, style.UPRIGHT)) > 300
    assert len(places(fallen, style.UPRIGHT)) == 0
    assert len(places(fallen, style.POLE)) > 300


def test_a_large_pole_fits_too(swing_up: Episode) -> None:
    picture = list(frames(part(swing_up, 0, 60), 0.6413, TRACK))[-1]
    pole = places(picture, style.POLE)
    assert pole[:, 1].min() > 40


def test_jitter_does_not_accumulate(balance: Episode) -> None:
    generator = np.random.default_rng(3)
    time = np.concatenate(([0.0], np.cumsum(generator.uniform(0.017, 0.0237, 500))))
    jittered = dataclasses.replace(balance, time=time)
    waits = durations(jittered)[:-1]
    assert sum(waits) == pytest.approx(1000 * time[-1], abs=10)
    assert all(wait % 10 == 0 for wait in waits)


def test_the_last_row_is_always_drawn(swing_up: Episode) -> None:
    assert rows(part(swing_up, 0, 7), every=3) == [0, 3, 6, 7]
    assert len(list(frames(part(swing_up, 0, 7), POLE, TRACK, every=3))) == 4


def test_leaving_the_track_is_shown(runaway: Episode) -> None:
    *_, before, last = frames(part(runaway, runaway.steps - 4, 4), POLE, TRACK)
    header = (0, 36, 300, 56)
    assert len(places(last.crop(header), style.LIMIT)) > 50
    assert len(places(before.crop(header), style.LIMIT)) == 0


def test_a_title_never_runs_into_the_numbers(balance: Episode) -> None:
    short = part(balance, 0, 1)
    words = "A title that somebody wrote without a thought for the width of pictures"
    plain, titled = (next(iter(frames(short, POLE, TRACK, text))) for text in ("", words))
    left, _, right, _ = ImageChops.difference(plain.convert("RGB"), titled.convert("RGB")).getbbox()
    assert left >= 18
    assert right <= 295


def test_write_gif_makes_folders(tmp_path, balance: Episode) -> None:
    path = write_gif(part(balance, 0, 10), tmp_path / "figures" / "episode.gif", POLE, TRACK)
    assert path.read_bytes().startswith(b"GIF89a")


def test_a_smaller_animation_takes_as_long(tmp_path, balance: Episode) -> None:
    path = write_gif(part(balance, 0, 41), tmp_path / "episode.gif", POLE, TRACK)
    whole, small = [*shown(path.read_bytes())], [*shown(smaller(path, 160, 4))]
    assert small[0][0].size == (160, 107)
    assert len(small) == -(-len(whole) // 4)
    assert sum(wait for _, wait in small) == sum(wait for _, wait in whole)
    assert len(smaller(path, 160, 4)) < path.stat().st_size / 4
