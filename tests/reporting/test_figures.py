"""Figures show the numbers that they were given, in the units that their axes name."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures import (
    THESIS_GUIDES,
    behaviour,
    comparison,
    learning_curve,
    png,
    randomization_histograms,
    save,
)
from cartpole_rl.reporting.figures.behaviours import wrapped_line
from cartpole_rl.reporting.figures.comparisons import student_interval
from cartpole_rl.tasks.episode import Episode

TRACK = 0.407


def line_of(axes: Axes, colour: str) -> np.ndarray:
    """The points [P, 2] of the longest line of a colour."""
    lines = [line for line in axes.lines if colors.same_color(line.get_color(), colour)]
    return max((line.get_xydata() for line in lines), key=len)


def words(figure: Figure) -> str:
    """Every text of a drawn figure."""
    figure.draw_without_rendering()
    return " | ".join(
        text.get_text() for text in figure.findobj(match=lambda each: hasattr(each, "get_text"))
    )


def records(scores: list[float], frames_apart: int = 100_000) -> list[dict]:
    """Evaluations a second apart whose episodes lie 100 around the mean."""
    return [
        {
            "transitions": (i + 1) * frames_apart,
            "seconds": float(i + 1),
            "score": score,
            "score_min": score - 100,
            "score_max": score + 100,
        }
        for i, score in enumerate(scores)
    ]


class TestBehaviour:
    def test_panels_show_the_episode_in_their_units(self, swing_up: Episode) -> None:
        angle, position, motor = behaviour(swing_up, "A title", TRACK).axes
        time, centimetres = line_of(position, style.CART).T
        np.testing.assert_allclose(time, swing_up.time)
        np.testing.assert_allclose(centimetres, 100 * swing_up.x)
        steps = next(patch for patch in motor.patches if isinstance(patch, StepPatch)).get_data()
        np.testing.assert_array_equal(steps.values, swing_up.motor)
        np.testing.assert_array_equal(steps.edges, swing_up.time)
        degrees = line_of(angle, style.POLE)[:, 1]
        for value in np.degrees(swing_up.theta[::50]):
            assert np.nanmin(np.abs((degrees - value + 180) % 360 - 180)) < 1e-6
        assert [axes.get_ylabel() for axes in (angle, position, motor)] == [
            "pole angle (deg)",
            "cart (cm)",
            "motor value",
        ]
        assert motor.get_xlabel() == "time (s)"

    def test_the_band_is_five_degrees_each_way(self, swing_up: Episode) -> None:
        band = behaviour(swing_up).axes[0].patches[0]
        assert (band.get_y(), band.get_height()) == pytest.approx((-5, 10))

    def test_track_ends_are_drawn_where_they_are(self, swing_up: Episode) -> None:
        position = behaviour(swing_up, track_half_length=TRACK).axes[1]
        limits = [line for line in position.lines if line.get_color() == style.LIMIT]
        assert sorted(line.get_ydata()[0] for line in limits) == pytest.approx([-40.7, 40.7])
        low, high = position.get_ylim()
        assert low < -40.7
        assert high > 40.7

    def test_says_score_ending_and_time_upright(self, swing_up: Episode, runaway: Episode) -> None:
        text = words(behaviour(swing_up, "A title"))
        assert "A title" in text
        assert f"score {swing_up.score.sum():.0f}" in text
        assert "time was up after 10.0 s" in text
        share = np.mean(np.abs((swing_up.theta[1:] + math.pi) % (2 * math.pi) - math.pi) < math.radians(5))
        assert f"upright {100 * share:.0f} % of the time" in text
        assert "left the track" in words(behaviour(runaway))

    def test_the_mark_stands_where_the_pole_stays_up(self, swing_up: Episode) -> None:
        angle = behaviour(swing_up).axes[0]
        moment = next(line for line in angle.lines if line.get_color() == style.UPRIGHT).get_xdata()[0]
        lean = np.abs((swing_up.theta + math.pi) % (2 * math.pi) - math.pi)
        after = (swing_up.time >= moment) & (swing_up.time < moment + 1)
        assert np.all(lean[after] < math.radians(5))
        assert lean[np.searchsorted(swing_up.time, moment) - 1] >= math.radians(5)

    def test_a_small_swing_is_enlarged(self, balance: Episode) -> None:
        low, high = behaviour(balance).axes[0].get_ylim()
        assert high - low < 30

    def test_an_episode_of_one_period_can_be_drawn(self, swing_up: Episode) -> None:
        short = {field.name: getattr(swing_up, field.name) for field in dataclasses.fields(swing_up)}
        short = {
            name: each[: 2 if len(each) == 501 else 1]
            for name, each in short.items()
            if name not in ("ended_by", "origin")
        }
        assert png(behaviour(Episode(**short, ended_by="link")))

    @given(
        st.lists(st.floats(-2.9, 2.9), min_size=2, max_size=60),
        st.floats(-10, 10),
        st.booleans(),
    )
    def test_a_wrapped_line_never_jumps(self, steps: list[float], start: float, wrapped: bool) -> None:
        theta = start + np.cumsum(steps)
        given_theta = (theta + math.pi) % (2 * math.pi) - math.pi if wrapped else theta
        time = np.arange(len(theta)) * 0.02
        times, degrees = wrapped_line(time, given_theta)
        assert np.nanmax(np.abs(degrees)) <= 180 + 1e-9
        drawn = np.abs(np.diff(degrees))
        longest = np.degrees(np.abs(np.diff(theta)).max())
        assert np.all(drawn[np.isfinite(drawn)] <= longest + 1e-6)
        assert np.all(np.diff(times) >= -1e-12)

    def test_a_line_leaves_and_comes_in_at_the_edges(self) -> None:
        times, degrees = wrapped_line(np.array([0.0, 1.0]), np.radians([170.0, 200.0]))
        np.testing.assert_allclose(times, [0, 1 / 3, 1 / 3, 1 / 3, 1])
        np.testing.assert_allclose(degrees, [170, 180, np.nan, -180, -160])


class TestLearningCurve:
    def test_one_run_is_a_line_over_millions_of_frames_in_its_band(self) -> None:
        axes = learning_curve([("medium", records([100, 900, 4100]))]).axes[0]
        np.testing.assert_allclose(
            line_of(axes, style.series_colour(0)), [[0.1, 100], [0.2, 900], [0.3, 4100]]
        )
        band = axes.collections[0].get_paths()[0].vertices
        assert band[:, 1].min() == 0
        assert band[:, 1].max() == 4200
        assert axes.get_xlabel() == "transitions (millions)"
        assert axes.get_ylabel() == "score of an episode"

    def test_runs_of_one_label_get_their_median(self) -> None:
        runs = [("medium", records([score, 2 * score])) for score in (100.0, 300.0, 2000.0)]
        axes = learning_curve(runs).axes[0]
        assert len(axes.lines) == 4
        thick = max(axes.lines, key=lambda line: line.get_linewidth())
        np.testing.assert_allclose(thick.get_ydata(), [300, 600])
        assert "median of 3 runs" in axes.get_legend().get_texts()[0].get_text()

    def test_each_label_has_its_colour(self) -> None:
        runs = [("Adam", records([1, 2])), ("AdamW", records([3, 4])), ("Adam", records([5, 6]))]
        axes = learning_curve(runs).axes[0]
        assert {line.get_color() for line in axes.lines} == {style.series_colour(0), style.series_colour(1)}
        assert len(axes.get_legend().get_texts()) == 2

    def test_runs_with_other_evaluation_frames_meet_in_between(self) -> None:
        runs = [("a", records([0, 300], 300_000)), ("a", records([0, 100, 200, 300, 400, 500, 600]))]
        axes = learning_curve(runs).axes[0]
        thick = max(axes.lines, key=lambda line: line.get_linewidth())
        frames, scores = thick.get_xydata().T
        assert frames[0] == pytest.approx(0.3)
        assert frames[-1] == pytest.approx(0.6)
        assert scores[0] == pytest.approx((0 + 200) / 2)
        assert scores[-1] == pytest.approx((300 + 500) / 2)

    def test_says_when_the_target_was_reached(self) -> None:
        runs = [("a", records([0, 4000, 5000])), ("a", records([0, 0, 4500])), ("a", records([0, 0, 0]))]
        text = words(learning_curve(runs, threshold=4000, guides=THESIS_GUIDES))
        assert "target 4000\n2 of 3 runs,\nmedian 2 s" in text
        assert "very good" in text
        assert "not reached" in words(learning_curve(runs, threshold=6000))

    @pytest.mark.parametrize("histories", [[], [("a", [])]])
    def test_nothing_to_draw_is_an_error(self, histories: list) -> None:
        with pytest.raises(ConfigError, match="at least one"):
            learning_curve(histories)


class TestComparison:
    RESULTS = {"simulated": [4000.0, 4100.0, 4200.0], "emulated": [3000.0, 3200.0]}  # noqa: RUF012

    def test_dots_are_the_episodes_and_lines_their_means(self) -> None:
        axes = comparison(self.RESULTS).axes[0]
        dots, mean = axes.lines[0], axes.lines[1]
        assert sorted(dots.get_ydata()) == self.RESULTS["simulated"]
        np.testing.assert_allclose(mean.get_ydata(), 4100)
        assert axes.get_ylabel() == "score of an episode"

    def test_says_interval_and_ratio(self) -> None:
        text = words(comparison(self.RESULTS, intervals={"simulated": (4080.0, 4120.0)}))
        assert "4100 ± 20" in text
        assert "0.76 × simulated" in text
        assert "2 episodes" in text

    def test_student_interval_holds_the_mean_95_times_in_100(self) -> None:
        generator = np.random.default_rng(0)
        intervals = [student_interval(generator.normal(5, 2, 8)) for _ in range(2000)]
        assert np.mean([low < 5 < high for low, high in intervals]) == pytest.approx(0.95, abs=0.015)

    def test_a_single_episode_has_no_interval(self) -> None:
        assert png(comparison({"serial": [4000.0]}))
        assert all(math.isnan(end) for end in student_interval(np.array([1.0])))

    @pytest.mark.parametrize("results", [{}, {"serial": []}])
    def test_nothing_to_draw_is_an_error(self, results: dict) -> None:
        with pytest.raises(ConfigError, match="at least one"):
            comparison(results)


class TestRandomizationHistograms:
    def test_each_parameter_has_a_panel_that_counts_all_draws(self) -> None:
        generator = np.random.default_rng(1)
        draws = {f"p{i} (kg)": generator.uniform(i, i + 1, 300) for i in range(5)}
        figure = randomization_histograms(draws, nominal={"p2 (kg)": 2.5})
        panels = [axes for axes in figure.axes if axes.get_visible()]
        assert [axes.get_title(loc="left") for axes in panels] == list(draws)
        for axes, values in zip(panels, draws.values(), strict=True):
            assert sum(bar.get_height() for bar in axes.patches) == 300
            assert axes.patches[0].get_x() == pytest.approx(values.min())
        assert panels[2].lines[0].get_xdata()[0] == 2.5

    def test_a_parameter_that_never_varies_is_said_to_be_fixed(self) -> None:
        assert "fixed at 9.81" in words(randomization_histograms({"gravity": np.full(10, 9.81)}))

    @pytest.mark.parametrize("draws", [{}, {"mass": [math.nan]}])
    def test_nothing_to_draw_is_an_error(self, draws: dict) -> None:
        with pytest.raises(ConfigError):
            randomization_histograms(draws)


@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_save_writes_the_format_that_the_ending_names(
    tmp_path, balance: Episode, ending: str, magic: bytes
) -> None:
    path = save(behaviour(balance), tmp_path / "new" / f"picture.{ending}")
    assert path.read_bytes().startswith(magic)


def test_no_figure_needs_pyplot() -> None:
    code = (
        "import sys, cartpole_rl.reporting.figures as f;"
        "f.png(f.comparison({'a': [1.0, 2.0]}));"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
