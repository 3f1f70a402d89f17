"""Held-out recordings share nothing with those that a model learns from."""

import numpy as np
import pytest

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.windows import LEAD, held_out_windows, history_periods, split
from cartpole_rl.tasks.episode import Episode


def episode(periods: int, period: float) -> Episode:
    """Motion whose counts and motor values are the numbers of their rows."""
    rows = np.arange(periods + 1)
    zeros, steps = np.zeros(periods + 1), np.zeros(periods)
    counts = np.stack((rows, rows), 1)
    motor = rows[:-1]
    return Episode(period * rows, zeros, zeros, zeros, zeros, counts, motor, steps, steps, steps, "time")


@pytest.mark.parametrize("period", [0.005, 0.02, 0.1])
def test_windows_have_their_lead_and_history(period: float) -> None:
    windows = held_out_windows([episode(round(8 / period), period)], period, 1.0)
    assert (windows.periods - windows.lead) * period == pytest.approx(1.0)
    assert windows.lead * period >= LEAD
    assert (windows.motors[history_periods(period)] == windows.positions[0, 0]).all()
    assert windows.number > 3


def test_too_short_is_named() -> None:
    with pytest.raises(RecordingError, match=r"have no 1\.32 s without a lost frame"):
        held_out_windows([episode(60, 0.02)], 0.02, 1.0)


def test_every_fifth_is_held_out_or_the_last_fifth_of_a_few() -> None:
    whole = [episode(100 + number, 0.02) for number in range(10)]
    learned, held_out = split(whole)
    assert [each.steps for each in held_out] == [102, 107]
    assert len(learned) == 8
    learned, held_out = split(whole[:1])
    assert (learned[0].steps, held_out[0].steps) == (80, 20)
    assert held_out[0].motor[0] == learned[0].motor[-1] + 1
