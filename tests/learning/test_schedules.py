"""The ends and the middle of the schedules, and the iterations at which training evaluates."""

import pytest

from cartpole_rl.learning.schedules import half_cosine, linear
from cartpole_rl.learning.training import evenly_spaced


@pytest.mark.parametrize("schedule", [linear, half_cosine])
@pytest.mark.parametrize(("start", "end"), [(1.0, 0.05), (0.4, 1.0), (2.0, 2.0)])
def test_ends_and_middle(schedule, start: float, end: float) -> None:
    assert schedule(start, end, 0.0) == pytest.approx(start)
    assert schedule(start, end, 0.5) == pytest.approx((start + end) / 2)
    assert schedule(start, end, 1.0) == pytest.approx(end)
    assert schedule(start, end, -1.0) == pytest.approx(start)
    assert schedule(start, end, 7.0) == pytest.approx(end)


def test_the_half_cosine_is_flat_at_both_ends() -> None:
    steps = [half_cosine(1.0, 0.0, (i + 1) / 100) - half_cosine(1.0, 0.0, i / 100) for i in range(100)]
    assert max(steps) < 0
    assert abs(steps[0]) < 0.1 * abs(steps[50])
    assert abs(steps[-1]) < 0.1 * abs(steps[50])


@pytest.mark.parametrize(("count", "end"), [(1, 7), (3, 10), (12, 427), (5, 5)])
def test_evenly_spaced_ends_at_the_end(count: int, end: int) -> None:
    spaced = evenly_spaced(count, end)
    gaps = [after - before for before, after in zip([0, *spaced], spaced, strict=False)]
    assert len(spaced) == count
    assert spaced[-1] == end
    assert max(gaps) - min(gaps) <= 1
    assert min(gaps) >= 1
