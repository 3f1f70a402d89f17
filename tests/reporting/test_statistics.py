"""Interquartile means, their intervals and profiles against scipy and by hand."""

import numpy as np
import pytest
from scipy import stats

from cartpole_rl.reporting.runs_page import METHOD
from cartpole_rl.reporting.statistics import (
    RESAMPLES,
    difference,
    estimate,
    interquartile_mean,
    paired_difference,
    paired_improvement,
    performance_profile,
    probability_of_improvement,
)

SCORES = np.random.default_rng(3).normal(3000, 900, 10)
OTHERS = np.random.default_rng(4).normal(2500, 900, 10)


def test_two_of_ten_values_are_cut_off_at_each_end() -> None:
    assert interquartile_mean(SCORES) == pytest.approx(np.sort(SCORES)[2:8].mean())
    assert interquartile_mean([1.0, 2.0, 30.0]) == 11.0


def test_the_interval_is_that_of_the_percentile_bootstrap() -> None:
    found = estimate(SCORES)
    theirs = stats.bootstrap(
        (SCORES,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        method="percentile",
        n_resamples=20000,
        rng=np.random.default_rng(9),
    ).confidence_interval
    assert found.value == pytest.approx(interquartile_mean(SCORES))
    assert found.low == pytest.approx(theirs.low, abs=60)
    assert found.high == pytest.approx(theirs.high, abs=60)
    assert found.agents == 10


@pytest.mark.parametrize(("agents", "covered"), [(3, 73), (10, 94)])
def test_the_page_states_how_often_an_interval_covers_the_true_value(agents: int, covered: int) -> None:
    """The interquartile mean of a normal distribution is its mean; the standard error is below 3 here."""
    draws = np.random.default_rng(6).normal(0.0, 1.0, (300, agents))
    share = 100 * np.mean([(found := estimate(draw)).low <= 0 <= found.high for draw in draws])
    assert share == pytest.approx(covered, abs=6)
    assert str(covered) in METHOD


def test_strata_are_resampled_apart() -> None:
    """Two strata without spread of their own have an IQM without spread, however far apart they are."""
    found = estimate([1.0, 1.0, 1.0, 1.0], [5.0, 5.0, 5.0, 5.0])
    assert (found.value, found.low, found.high) == (3.0, 3.0, 3.0)
    pooled = estimate([1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0])
    assert pooled.low is not None
    assert pooled.low < 2


def test_one_agent_has_no_interval_and_none_no_estimate() -> None:
    assert estimate([7.0]) == (7.0, None, None, 1)
    with pytest.raises(ValueError, match="at least one value"):
        estimate([])


def test_probability_of_improvement_is_mann_and_whitneys() -> None:
    expected = stats.mannwhitneyu(SCORES, OTHERS).statistic / 100
    assert probability_of_improvement(SCORES, OTHERS).value == pytest.approx(expected)
    assert probability_of_improvement([1.0, 1.0], [1.0, 1.0]).value == 0.5


def test_probability_of_improvement_is_the_share_of_pairs_in_every_resample() -> None:
    values, others = np.array([1.0, 2.0, 2.0, 3.0, 7.0]), np.array([2.0, 2.0, 0.0])
    generator = np.random.default_rng(0)
    a, b = (each[generator.integers(each.size, size=(RESAMPLES, each.size))] for each in (values, others))
    shares = 0.5 + 0.5 * np.sign(a[:, :, None] - b[:, None, :]).mean(axis=(1, 2))
    found = probability_of_improvement(values, others)
    assert found.value == 0.5 + 0.5 * np.sign(values[:, None] - others).mean()
    np.testing.assert_array_equal([found.low, found.high], np.percentile(shares, [2.5, 97.5]))


def test_the_same_agents_are_compared_in_pairs() -> None:
    """Agents that differ by 900 and all gain about 50 show a difference that independent ones do not show."""
    gains = np.linspace(30, 70, 10)
    found, apart = paired_difference(SCORES + gains, SCORES), difference(SCORES + gains, SCORES)
    assert found.value == pytest.approx(50)
    assert 30 < found.low < 50 < found.high < 70
    assert apart.low < 0
    assert paired_improvement([2.0, 3.0, 1.0, 5.0], [1.0, 3.0, 2.0, 4.0]).value == 0.625


def test_a_profile_falls_from_one_to_nothing() -> None:
    share, low, high = performance_profile([1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.5, 4.0])
    assert share.tolist() == [1.0, 0.75, 0.5, 0.0]
    assert (low <= share).all()
    assert (share <= high).all()
    assert low[2] < 0.5 < high[2]
