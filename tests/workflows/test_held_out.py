"""Recordings to learn from and held-out ones: nothing is in both, nothing is lost."""

import numpy as np
import pytest

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.held_out import LEAD
from cartpole_rl.identification.windows import HISTORY
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.held_out import HELD_OUT, held_out_windows, part, split

PERIOD = 0.02  # s


def numbered(steps: int, first: int = 0) -> Episode:
    """An episode whose motor values and cart counts number its periods from `first`."""
    rows = np.arange(first, first + steps + 1)
    zeros = np.zeros(steps + 1)
    return Episode(
        time=np.arange(steps + 1) * PERIOD,
        x=rows.astype(float),
        x_dot=zeros,
        theta=zeros,
        theta_dot=zeros,
        counts=np.stack((rows, rows), 1),
        motor=rows[:-1],
        score=zeros[1:],
        score_upright=zeros[1:],
        reward=zeros[1:],
        ended_by="time",
    )


@pytest.mark.parametrize("number", [HELD_OUT, 11, 23])
def test_every_fifth_of_many_recordings_is_held_out(number: int) -> None:
    episodes = [numbered(3, 10 * index) for index in range(number)]
    learned_from, held_out = split(episodes)
    first_motors = [[episode.motor[0] for episode in part] for part in (learned_from, held_out)]
    assert first_motors[1] == list(range(20, 10 * number, 50))
    assert first_motors[0] == [10 * index for index in range(number) if index % HELD_OUT != 2]


@pytest.mark.parametrize("steps", [100, 103])
def test_the_last_fifth_of_each_of_a_few_recordings_is_held_out(steps: int) -> None:
    learned_from, held_out = split([numbered(steps), numbered(steps, 1000)])
    for first, (kept, later) in zip((0, 1000), zip(learned_from, held_out, strict=True), strict=True):
        assert [*kept.motor, *later.motor] == list(range(first, first + steps))
        assert later.steps == steps // HELD_OUT
        assert kept.counts[-1, 0] == later.counts[0, 0]  # the state between the parts belongs to both


def test_a_part_has_a_row_more_than_periods() -> None:
    cut = part(numbered(10), 3, 7)
    assert cut.motor.tolist() == [3, 4, 5, 6]
    assert cut.counts[:, 0].tolist() == [3, 4, 5, 6, 7]
    assert cut.time[0] == pytest.approx(3 * PERIOD)


def test_windows_begin_with_the_motor_values_of_their_own_episode() -> None:
    ahead = LEAD + 25
    windows = held_out_windows([numbered(3 * (HISTORY + ahead))], PERIOD, horizon=0.5)
    assert windows.periods == ahead
    assert len(windows.motors) == HISTORY + ahead
    starts = windows.positions[0, 0].astype(int)
    for window, start in enumerate(starts):
        assert windows.motors[:, window].tolist() == list(range(start - HISTORY, start + ahead))
    half = (HISTORY + ahead) // 2
    assert sorted(starts)[:2] == [HISTORY, HISTORY + half]


def test_recordings_that_are_too_short_are_refused() -> None:
    with pytest.raises(RecordingError, match="record longer episodes"):
        held_out_windows([numbered(20)], PERIOD, horizon=1.0)
