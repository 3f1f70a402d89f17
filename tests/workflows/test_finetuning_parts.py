"""Files of a fine-tuning, its evaluations, and the settings of its learning."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cartpole_rl.choices import choice
from cartpole_rl.errors import CheckpointError, LinkError
from cartpole_rl.evaluation.driver import Driven, DriveRequest
from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, TrainingCheckpoint, load_training
from cartpole_rl.learning.settings import FinetuningSettings, LearningSettings
from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import FinetuneConfig
from cartpole_rl.workflows.finetuning_cart import DrivenCart
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_learner import simulated_learning
from cartpole_rl.workflows.loading import load_settings, recorded_settings

EPISODE = Episode(
    time=0.02 * np.arange(3),
    x=np.zeros(3),
    x_dot=np.zeros(3),
    theta=np.full(3, np.pi),
    theta_dot=np.zeros(3),
    counts=np.zeros((3, 2), dtype=np.int64),
    motor=np.array([100, -100]),
    score=np.ones(2),
    score_upright=np.ones(2),
    reward=np.ones(2),
    ended_by="time",
)


class Script:
    """A driver whose episodes end as `endings` say."""

    def __init__(self, *endings: str) -> None:
        self.endings = iter(endings)

    def start(self, drive: DriveRequest) -> None:
        """Do nothing."""

    def result(self) -> Driven:
        """Return the next episode."""
        ending = next(self.endings)
        episode = EPISODE.first(0) if ending == "empty" else EPISODE
        return Driven(replace(episode, ended_by=ending.replace("empty", "fault")), LinkStatistics())


@pytest.fixture
def files(tmp_path: Path) -> FinetuningFiles:
    return FinetuningFiles(
        tmp_path, load_settings(FinetuneConfig, {"run": "somewhere", "evaluation_episodes": 3})
    )


def test_recorded_episodes_are_counted_by_stage(files: FinetuningFiles) -> None:
    for stage, count in ((Stage.BEFORE, 1), (Stage.TUNE, 2)):
        for number in range(count):
            files.write_episode(stage, number, EPISODE)
    assert [files.count(stage) for stage in Stage] == [1, 2, 0]
    assert files.path(Stage.TUNE, 1) == files.folder / "recordings/tune_001.csv"
    (first, second) = files.episodes(Stage.TUNE)
    assert first.motor.tolist() == second.motor.tolist() == [100, -100]
    assert "# pole_length_m: 0.3530" in files.path(Stage.BEFORE, 0).read_text()


def test_a_checkpoint_restores_its_settings(files: FinetuningFiles) -> None:
    files.save({}, 2)
    checkpoint = load_training(files.folder, FINETUNING_FORMAT)
    assert checkpoint.step == 2
    assert recorded_settings(FinetuneConfig, checkpoint.config, "resume=run") == files.config


def test_settings_of_another_version_are_named() -> None:
    old = TrainingCheckpoint({"run": "somewhere", "prior": 0.1}, {}, 0)
    with pytest.raises(CheckpointError, match=r"resume=run is of another version .*prior: there is no such"):
        recorded_settings(FinetuneConfig, old.config, "resume=run")


def test_learning_in_simulation_follows_the_settings() -> None:
    learning = LearningSettings(**choice("learning/fast"))
    gentle = FinetuningSettings(**choice("finetuning/gentle"))
    simulated = simulated_learning(learning, gentle, episodes=20)
    assert simulated.iterations == 20 * gentle.iterations
    assert simulated.epsilon == gentle.simulated_epsilon == (0.1, 0.02)
    assert simulated.epsilon_transitions == simulated.transitions // 2
    assert simulated.warmup_transitions == 0
    assert simulated.batch_size == learning.batch_size


@pytest.fixture
def log(tmp_path: Path) -> Iterator[TensorBoardLog]:
    with TensorBoardLog(tmp_path) as opened:
        yield opened


def test_an_episode_that_the_link_ended_is_driven_again(
    files: FinetuningFiles, log: TensorBoardLog, capsys: pytest.CaptureFixture[str]
) -> None:
    cart = DrivenCart(Script("time", "link", "link", "fault", "link", "time"), files, log)
    cart.evaluate(Stage.BEFORE, {})
    assert [each.ended_by for each in files.episodes(Stage.BEFORE)] == ["time", "fault", "time"]
    told = "before 2: the link was lost after 0.0 s; the episode does not count and is driven again"
    assert capsys.readouterr().out.splitlines()[1] == told


def test_a_link_that_is_lost_again_and_again_ends_the_run(
    files: FinetuningFiles, log: TensorBoardLog
) -> None:
    cart = DrivenCart(Script("time", "link", "link", "link"), files, log)
    with pytest.raises(LinkError, match=r"before 2: the link was lost after 0\.0 s, 3 times in succession"):
        cart.evaluate(Stage.BEFORE, {})
    assert files.count(Stage.BEFORE) == 1


@pytest.mark.parametrize("stage", [Stage.BEFORE, Stage.TUNE])
def test_an_episode_without_a_measured_period_is_driven_again(
    stage: Stage, files: FinetuningFiles, log: TensorBoardLog, capsys: pytest.CaptureFixture[str]
) -> None:
    cart = DrivenCart(Script("empty", "empty", "fault", "empty", "empty", "empty"), files, log)
    cart.start({}, 0.0, 0)
    cart.finish(stage, 0)
    assert [each.steps for each in files.episodes(stage)] == [2]
    told = f"{stage} 1: the cart reported a fault after 0.0 s; the episode does not count and is driven again"
    assert capsys.readouterr().out.splitlines()[0] == told
    cart.start({}, 0.0, 0)
    with pytest.raises(LinkError, match=r"2: the cart reported a fault after 0\.0 s, 3 times in succession"):
        cart.finish(stage, 1)


def test_an_episode_to_learn_from_counts_until_the_link_ended_it(
    files: FinetuningFiles, log: TensorBoardLog
) -> None:
    cart = DrivenCart(Script("link"), files, log)
    cart.finish(Stage.TUNE, 0)
    assert files.episode(Stage.TUNE, 0).ended_by == "link"
