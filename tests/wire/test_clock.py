"""The cart's ticks and clock wrap at 2^32; differences are right across the wrap."""

import pytest

from cartpole_rl.wire.messages import microseconds_between, seconds_between, ticks_between, went_back


@pytest.mark.parametrize(
    ("before", "after", "difference"), [(5, 7, 2), (2**32 - 1, 1, 2), (7, 7, 0), (7, 5, 2**32 - 2)]
)
def test_differences_are_right_across_the_wrap(before: int, after: int, difference: int) -> None:
    assert ticks_between(before, after) == difference
    assert microseconds_between(before, after) == difference
    assert seconds_between(before, after) == pytest.approx(difference * 1e-6)


def test_an_older_number_is_recognized() -> None:
    assert went_back(ticks_between(7, 5))
    assert went_back(ticks_between(3, 2**32 - 3))
    assert not went_back(ticks_between(5, 7))
    assert not went_back(ticks_between(2**32 - 3, 3))
    assert not went_back(ticks_between(7, 7))
