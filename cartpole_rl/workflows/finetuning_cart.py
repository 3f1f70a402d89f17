"""The cart of a fine-tuning, driven by its own process; each finished episode is written and logged."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from tqdm import tqdm

from cartpole_rl.errors import LearningError, LinkError
from cartpole_rl.evaluation.driver import Driver, DriveRequest
from cartpole_rl.evaluation.driving_policy import Weights
from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.reporting.words import ending_text, guard_text
from cartpole_rl.scheduling import giving_precedence
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import FinetuneConfig
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.person import print_message

LARGEST_LOSSES = 3  # of the link in succession, in an evaluation


class DrivenCart:
    """Drives episodes with `driver`, writes them to `files` and logs them to `log`."""

    def __init__(self, driver: Driver, files: FinetuningFiles, log: TensorBoardLog) -> None:
        self.driver, self.files, self.log = driver, files, log
        self.link: LinkStatistics | None = None  # since the driver started; None before its first episode

    @property
    def config(self) -> FinetuneConfig:
        """The settings of the fine-tuning."""
        return self.files.config

    def evaluate(self, stage: Stage, weights: Weights) -> None:
        """Drive the episodes of a stage that are not on disk, without exploration.

        Raises the errors of `finish`.
        """
        while (number := self.files.count(stage)) < self.config.evaluation_episodes:
            self.start(weights, 0.0, self.config.seed)
            self.finish(stage, number)

    def start(self, weights: Weights, epsilon: float, seed: int) -> None:
        """Start an episode and return at once. Raises LinkError."""
        self.request = DriveRequest(weights, epsilon, seed)
        self.driver.start(self.request)

    def finish(self, stage: Stage, number: int) -> None:
        """Wait for the started episode, write and log it.

        An episode without a control period is driven again; so is an evaluation that the link ended, since it
        says nothing about the agent. Raises LinkError if that happens LARGEST_LOSSES times in succession, and
        the errors of `result`.
        """
        for losses in range(1, LARGEST_LOSSES + 1):
            episode = self.result(stage, number)
            if episode.steps and (stage is Stage.TUNE or episode.ended_by != Ending.LINK):
                self.keep(stage, number, episode)
                return
            lost = f"{stage} {number + 1}: {ending_text(episode)}"
            if losses < LARGEST_LOSSES:
                tqdm.write(f"{lost}; the episode does not count and is driven again")
                self.driver.start(self.request)
        raise LinkError(f"{lost}, {losses} times in succession: check the cart's cables")

    def result(self, stage: Stage, number: int) -> Episode:
        """Wait for the started episode.

        Raises LinkError, and LearningError if the network's numbers were not finite: the cart was stopped.
        """
        driven = self.driver.result()
        self.link = driven.link
        episode = driven.episode
        if episode.ended_by == Ending.NON_FINITE:
            raise LearningError(
                f"{stage} {number + 1}: an observation or an action value was not finite, so the cart was "
                "stopped; nothing is learned from this episode"
            )
        return episode

    def keep(self, stage: Stage, number: int, episode: Episode) -> None:
        """Write and log an episode."""
        self.files.write_episode(stage, number, episode)
        score, step = float(episode.score.sum()), self.step(stage, number + 1)
        share = None if episode.guarded is None else float(episode.guarded.mean())
        self.log.scalars({f"cart/score_{stage}": score, f"cart/guarded_{stage}": share}, step)
        assert self.link is not None
        summary = vars(self.link.summary())
        self.log.scalars({f"link/{key}": float(value) for key, value in summary.items()}, step)
        self.log.flush()
        tqdm.write(
            f"{stage} {number + 1}: score {score:.0f}, ended by {episode.ended_by}{guard_text(episode)}"
        )

    def step(self, stage: Stage, number: int) -> int:
        """Return TensorBoard's step of a stage's episode `number`, from 1: the stages follow each other."""
        evaluations, episodes = self.config.evaluation_episodes, self.config.episodes
        return {Stage.BEFORE: 0, Stage.TUNE: evaluations, Stage.AFTER: evaluations + episodes}[stage] + number

    def link_summary(self) -> dict[str, Any]:
        """Return counts of lost, damaged and late frames, and the latency; empty before the first episode."""
        if self.link is None:
            return {}
        return {**vars(self.link.summary()), "latency_override": self.link.latency_override()}


@contextmanager
def yielding_to(driver: Driver, learns_here: bool) -> Iterator[None]:
    """Lower this process's priority, but not that of the driver or of an emulated cart: they have started.

    A process that does not learn keeps its priority: it waits while the cart is driven.
    """
    if not driver.has_priority:
        print_message(
            "finetune",
            "other processes may delay the cart: no real-time priority (see `ulimit -r` and "
            "docs/first-hour.md)",
        )
    with giving_precedence() if learns_here else nullcontext():
        yield
