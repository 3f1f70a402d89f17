"""TensorBoard reads back what was logged, also after a resume."""

import io
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_files import files_of_at_most
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer
from tensorboard.plugins.hparams import metadata

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.animation import gif
from cartpole_rl.reporting.episodes import behaviour
from cartpole_rl.reporting.tensorboard import TensorBoardLog, cut_back, scalars
from cartpole_rl.tasks.episode import Episode


def read(folder: Path) -> EventAccumulator:
    """Everything that a folder's event files hold."""
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "histograms": 0})
    accumulator.purge_orphaned_data = False
    return accumulator.Reload()


def points(folder: Path, name: str) -> dict[int, float]:
    """A curve as step -> value; fails if a step comes twice."""
    events = read(folder).Scalars(name)
    assert len({event.step for event in events}) == len(events)
    return {event.step: event.value for event in events}


def test_a_folder_that_it_cannot_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="this path is not UTF-8; give "):
        TensorBoardLog(tmp_path / os.fsdecode(b"caf\xe9"))


def test_scalars_round_trip(tmp_path: Path) -> None:
    with TensorBoardLog(tmp_path) as log:
        log.scalars({"train/loss": 0.5, "evaluation/score": 100}, 10)
        log.scalars({"train/loss": 0.25, "evaluation/score": None}, 20)
    assert points(tmp_path, "train/loss") == {10: 0.5, 20: 0.25}
    assert points(tmp_path, "evaluation/score") == {10: 100}
    assert scalars(tmp_path, "train/loss") == [(10, 0.5), (20, 0.25)]
    assert scalars(tmp_path, "train/other") == []


def test_a_histogram_counts_every_finite_value(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(3, 2, (50, 20))
    with TensorBoardLog(tmp_path) as log:
        log.histogram("q", values, 5)
        log.histogram("q", np.append(values, np.nan), 6)
        log.histogram("q", [], 7)
        log.histogram("constant", np.full(9, 0.57), 5)
    log_read = read(tmp_path)
    (event, with_nan) = log_read.Histograms("q")
    assert (event.step, with_nan.step) == (5, 6)
    assert event.histogram_value.num == with_nan.histogram_value.num == 1000
    assert sum(event.histogram_value.bucket) == 1000
    assert event.histogram_value.min == pytest.approx(values.min())
    assert event.histogram_value.sum == pytest.approx(values.sum())
    assert sum(log_read.Histograms("constant")[0].histogram_value.bucket) == 9


def test_figures_and_animations_round_trip(tmp_path: Path, runaway: Episode) -> None:
    animation = gif(runaway, 0.3365, 0.407)
    with TensorBoardLog(tmp_path) as log:
        log.figure("behaviour", behaviour(runaway), 1)
        log.animation("episode", animation, 1)
    log_read = read(tmp_path)
    stored, played = log_read.Images("behaviour")[0], log_read.Images("episode")[0]
    with Image.open(io.BytesIO(stored.encoded_image_string)) as picture:
        assert picture.format == "PNG"
        assert picture.size == (stored.width, stored.height)
    assert played.encoded_image_string == animation
    assert (played.width, played.height) == (480, 320)


def test_hparams_list_three_runs_with_settings_and_final_metrics(tmp_path: Path) -> None:
    for seed in range(3):
        with TensorBoardLog(tmp_path / f"run{seed}") as log:
            log.scalars({"score": 1.0}, 50)
            log.hparams(
                {"seed": seed, "agent": {"gamma": 0.99}}, {"score": 4000.0 + seed, "never": None}, 100
            )
    runs = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    assert sorted(runs.Runs()) == ["run0", "run1", "run2"]
    for seed in range(3):
        content = runs.PluginRunToTagToContent(metadata.PLUGIN_NAME)[f"run{seed}"]
        start = metadata.parse_session_start_info_plugin_data(content[metadata.SESSION_START_INFO_TAG])
        assert start.hparams["seed"].number_value == seed
        assert start.hparams["agent.gamma"].number_value == 0.99
        assert metadata.SESSION_END_INFO_TAG in content
        assert [event.value for event in runs.Scalars(f"run{seed}", "summary/score")] == [4000.0 + seed]
        assert "summary/never" not in runs.Runs()[f"run{seed}"]["scalars"]


class TestResume:
    def test_later_points_are_rewritten_and_earlier_ones_kept(self, tmp_path: Path) -> None:
        with TensorBoardLog(tmp_path) as log:
            for step in (0, 10, 20, 25, 30):
                log.scalars({"a": step, "b": -step}, step)
                log.histogram("h", [1.0, 2.0], step)
        with TensorBoardLog(tmp_path, purge_step=21) as log:
            for step in (30, 40):
                log.scalars({"a": 1000 + step}, step)
        assert points(tmp_path, "a") == {0: 0, 10: 10, 20: 20, 30: 1030, 40: 1040}
        assert points(tmp_path, "b") == {0: 0, 10: -10, 20: -20}
        assert [event.step for event in read(tmp_path).Histograms("h")] == [0, 10, 20]

    def test_a_second_resume_cuts_what_the_first_wrote(self, tmp_path: Path) -> None:
        for purge_step, steps in ((None, (0, 10, 20)), (11, (20, 30)), (21, (30, 40))):
            with TensorBoardLog(tmp_path, purge_step=purge_step) as log:
                for step in steps:
                    log.scalars({"a": step}, step)
        assert sorted(points(tmp_path, "a")) == [0, 10, 20, 30, 40]

    def test_a_finished_run_that_is_continued_has_one_final_result(self, tmp_path: Path) -> None:
        with TensorBoardLog(tmp_path) as log:
            log.scalars({"a": 1.0}, 10)
            log.hparams({"frames": 10}, {"score": 1.0}, 10)
        with TensorBoardLog(tmp_path, purge_step=11) as log:
            log.scalars({"a": 2.0}, 20)
            log.hparams({"frames": 20}, {"score": 2.0}, 20)
        assert points(tmp_path, "a") == {10: 1.0, 20: 2.0}
        assert points(tmp_path, "summary/score") == {20: 2.0}
        content = read(tmp_path).PluginTagToContent(metadata.PLUGIN_NAME)[metadata.SESSION_START_INFO_TAG]
        assert metadata.parse_session_start_info_plugin_data(content).hparams["frames"].number_value == 20

    @pytest.mark.parametrize(("lost", "zeros"), [(5, 0), (5, 4005), (20, 4020), (40, 4040)])
    def test_what_a_kill_cut_short_or_a_power_cut_zeroed_is_dropped(
        self, lost: int, zeros: int, tmp_path: Path
    ) -> None:
        with TensorBoardLog(tmp_path) as log:
            log.scalars({"a": 1.0}, 1)
            log.scalars({"a": 2.0}, 2)
        (path,) = tmp_path.iterdir()
        path.write_bytes(path.read_bytes()[:-lost] + bytes(zeros))
        assert scalars(tmp_path, "a") == [(1, 1.0)]
        with TensorBoardLog(tmp_path, purge_step=2) as log:
            log.scalars({"a": 3.0}, 2)
        assert points(tmp_path, "a") == {1: 1.0, 2: 3.0}

    def test_a_full_disk_leaves_the_log_as_it_was(self, tmp_path: Path) -> None:
        with TensorBoardLog(tmp_path) as log:
            log.histogram("h", range(10_000), 1)
            log.scalars({"a": 1.0}, 2)
        (path,) = tmp_path.iterdir()
        before = path.read_bytes()
        with files_of_at_most(100), pytest.raises(OSError, match="File too large"):
            cut_back(tmp_path, 2)
        assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [(path.name, before)]

    def test_resuming_into_an_empty_folder_starts_a_new_log(self, tmp_path: Path) -> None:
        with TensorBoardLog(tmp_path / "new", purge_step=5) as log:
            log.scalars({"a": 1.0}, 5)
        assert points(tmp_path / "new", "a") == {5: 1.0}
