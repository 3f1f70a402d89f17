"""The live view fits every terminal and says what the cart does."""

import pytest

from cartpole_rl.evaluation.snapshots import Snapshot
from cartpole_rl.reporting.live_view import GREEN, LINES, PLAIN, RED, view

CALM = Snapshot(2, 120, -100, 0, 0, 1, 0.19, -0.25, 0.01, 0.5, 812.4, 0.38)
BUSY = CALM._replace(guard=-1, late_ticks=3, theta=3.0)


def test_it_shows_every_number() -> None:
    text = "\n".join(view("cart on /dev/ttyUSB0", CALM, fresh=True, width=80, colour=False))
    for words in (
        "cart on /dev/ttyUSB0: episode 2, step 120",
        "+19.0 cm  -0.25 m/s",
        "+0.6 deg  +0.50 rad/s",
        "-100",
        "812",
        "track guard off",
        "late ticks 0   lost frames 1",
    ):
        assert words in text


def test_marks_are_where_the_cart_is() -> None:
    _, cart, pole, motor, *_ = view("", CALM, fresh=True, width=80, colour=False)
    bars = [line[line.index("[") + 1 : line.index("]")] for line in (cart, pole, motor)]
    half = len(bars[0]) // 2
    assert [bar.index("#") - half for bar in bars] == [round(0.5 * half), 0, round(-100 / 255 * half)]


def test_the_guard_is_named() -> None:
    assert "track guard pushes left" in "\n".join(view("", BUSY, fresh=True, width=80, colour=False))


@pytest.mark.parametrize("width", [1, 20, 41, 80, 300])
@pytest.mark.parametrize("snapshot", [None, CALM, BUSY])
def test_it_fits(width: int, snapshot: Snapshot | None) -> None:
    lines = view("cart on /dev/ttyUSB0", snapshot, fresh=True, width=width, colour=False)
    assert len(lines) == LINES
    assert max(map(len, lines)) <= min(width, 100)


def test_colours_say_upright_guarded_and_late() -> None:
    _, _, calm, *_ = view("", CALM, fresh=True, width=80, colour=True)
    assert calm.startswith(GREEN)
    assert calm.endswith(PLAIN)
    painted = [line.startswith(RED) for line in view("", BUSY, fresh=True, width=80, colour=True)]
    assert painted == [False, False, False, False, True, True, False]


def test_an_old_snapshot_is_of_an_episode_that_has_ended() -> None:
    assert "episode 2, ended at step 120" in view("", CALM, fresh=False, width=80, colour=False)[0]
    assert "waiting for the cart" in view("", None, fresh=False, width=80, colour=False)[1]
