"""The figure of an episode shows it in the units that its axes name; a learning curve has mean and band."""

import dataclasses
import json
import math

import numpy as np
from figure_contents import line_of, words
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.patches import StepPatch

from cartpole_rl.drawing import colours
from cartpole_rl.reporting.episodes import behaviour, columns, learning_curve, wrapped_line
from cartpole_rl.reporting.style import series_colour
from cartpole_rl.tasks.episode import Episode, Origin

TRACK = 0.407  # m


def test_panels_show_the_episode_in_their_units(swing_up: Episode) -> None:
    angle, position, motor = behaviour(swing_up, "A title", TRACK).axes
    time, centimetres = line_of(position, colours.CART).T
    np.testing.assert_allclose(time, swing_up.time)
    np.testing.assert_allclose(centimetres, 100 * swing_up.x)
    steps = next(patch for patch in motor.patches if isinstance(patch, StepPatch)).get_data()
    np.testing.assert_array_equal(steps.values, swing_up.motor)
    np.testing.assert_array_equal(steps.edges, swing_up.time)
    degrees = line_of(angle, colours.POLE)[:, 1]
    for value in np.degrees(swing_up.theta[::50]):
        assert np.nanmin(np.abs((degrees - value + 180) % 360 - 180)) < 1e-6
    assert [axes.get_ylabel() for axes in (angle, position, motor)] == [
        "pole angle (deg)",
        "cart (cm)",
        "motor value",
    ]
    assert motor.get_xlabel() == "time (s)"


def test_subtitle_has_score_ending_and_time_upright(swing_up: Episode, runaway: Episode) -> None:
    text = words(behaviour(swing_up, "A title"))
    assert "A title" in text
    assert f"score {swing_up.score.sum():.0f}" in text
    assert "time was up after 10.0 s" in text
    share = np.mean(np.abs((swing_up.theta[1:] + math.pi) % (2 * math.pi) - math.pi) < math.radians(5))
    assert f"upright {100 * share:.0f} % of the time" in text
    assert "left the track" in words(behaviour(runaway))


def test_an_episode_of_one_period_can_be_drawn(swing_up: Episode) -> None:
    short = {field.name: getattr(swing_up, field.name) for field in dataclasses.fields(swing_up)}
    short = {
        name: each[: 2 if len(each) == 501 else 1]
        for name, each in short.items()
        if isinstance(each, np.ndarray)
    }
    assert "the link was lost" in words(behaviour(Episode(**short, ended_by="link")))


@given(
    st.lists(st.floats(-2.9, 2.9), min_size=2, max_size=60),
    st.floats(-10, 10),
    st.booleans(),
)
def test_a_wrapped_line_never_jumps(steps: list[float], start: float, wrapped: bool) -> None:
    theta = start + np.cumsum(steps)
    given_theta = (theta + math.pi) % (2 * math.pi) - math.pi if wrapped else theta
    time = np.arange(len(theta)) * 0.02
    times, degrees = wrapped_line(time, given_theta)
    assert np.nanmax(np.abs(degrees)) <= 180 + 1e-9
    drawn = np.abs(np.diff(degrees))
    longest = np.degrees(np.abs(np.diff(theta)).max())
    assert np.all(drawn[np.isfinite(drawn)] <= longest + 1e-6)
    assert np.all(np.diff(times) >= -1e-12)


def test_the_page_of_an_episode_gets_its_pole_its_last_motor_value_and_no_number_that_is_not_finite(
    swing_up: Episode,
) -> None:
    theta, score = swing_up.theta.copy(), swing_up.score.copy()
    theta[-1], score[-1] = math.inf, math.nan
    origin = Origin({"pole_com": 0.2}, {})
    shown = columns("name", dataclasses.replace(swing_up, theta=theta, score=score, origin=origin), TRACK)
    json.dumps(shown, allow_nan=False)
    assert (shown["theta"][-1], shown["score"][-1]) == (None, None)
    assert (shown["motor"][-1], shown["pole"]) == (swing_up.motor[-1], 0.4)


def records(scores: list[float]) -> list[dict]:
    """Evaluations a second apart whose episodes lie 100 around the mean."""
    return [
        {
            "transitions": (i + 1) * 100_000,
            "seconds": float(i + 1),
            "score": score,
            "score_min": score - 100,
            "score_max": score + 100,
        }
        for i, score in enumerate(scores)
    ]


def test_one_run_is_a_line_over_millions_of_transitions_in_its_band() -> None:
    axes = learning_curve(records([100, 900, 4100]), "score").axes[0]
    np.testing.assert_allclose(line_of(axes, series_colour(0)), [[0.1, 100], [0.2, 900], [0.3, 4100]])
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == 0
    assert band[:, 1].max() == 4200
    assert axes.get_xlabel() == "transitions (millions)"
    assert axes.get_ylabel() == "score (6.2) of an episode"
