"""The cart of a fine-tuning: driven by its own process, each finished episode on disk before the next one.

The recordings in the run folder say how far a fine-tuning has come: what is on disk is not driven again.
"""

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import Any

from cartpole_rl.errors import LearningError, LinkError, RecordingError
from cartpole_rl.evaluation.driver import Driver, EpisodeRequest
from cartpole_rl.evaluation.driving_policy import Weights
from cartpole_rl.evaluation.recordings import LENGTH, read_recording, write_recording
from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, TrainingCheckpoint, save_training
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.reporting.texts import ending_text, guard_text
from cartpole_rl.run_folder import CHECKPOINTS, RECORDINGS, START
from cartpole_rl.scheduling import giving_precedence
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.tasks.settings import Measure
from cartpole_rl.terminal import as_word, print_message
from cartpole_rl.workflows.config import FinetuneConfig

LARGEST_LOSSES = 3  # in succession, of episodes that do not count
SHORTEST = 1.0  # s of an episode to learn from that the link ended


class Stage(StrEnum):
    """Stages of a fine-tuning, in their order."""

    BEFORE = "before"  # evaluation of the trained agent
    TUNE = "tune"  # episodes to learn from
    AFTER = "after"  # evaluation of the fine-tuned agent


class FinetuningFiles:
    """Recordings and the checkpoint to resume from, in the run folder `folder`."""

    def __init__(self, folder: Path, config: FinetuneConfig) -> None:
        self.folder, self.config = folder, config

    @property
    def start(self) -> Path:
        """The copy of the agent that the fine-tuning started from; it exists until the end."""
        return self.folder / CHECKPOINTS / START

    def path(self, stage: Stage, number: int) -> Path:
        """Return the path of an episode's recording."""
        return self.folder / RECORDINGS / f"{stage}_{number:03d}.csv"

    def count(self, stage: Stage) -> int:
        """Return the number of recorded episodes of a stage."""
        return next(number for number in itertools.count() if not self.path(stage, number).exists())

    def episode(self, stage: Stage, number: int) -> Episode:
        """Read an episode. Raises RecordingError."""
        return read_recording(self.path(stage, number)).episode

    def check(self, learned: int) -> None:
        """Raise RecordingError for a damaged episode, or a missing one of the `learned` or amid others."""
        evaluations, episodes = self.config.evaluation_episodes, self.config.episodes
        numbers = {Stage.BEFORE: evaluations, Stage.TUNE: episodes, Stage.AFTER: evaluations}
        paths = [self.path(stage, number) for stage, count in numbers.items() for number in range(count)]
        first = next((place for place, path in enumerate(paths) if damage(path)), len(paths))
        if learned and first < evaluations + learned:
            remedy = f"put it back, or start anew: cartpole-finetune {as_word('run', self.config.run)}"
        elif any(path.exists() for path in paths[first:]):
            these = "it and the later ones" if paths[first].exists() else "the later ones"
            remedy = f"put it back, or move {these} away: they are driven again"
        else:
            return
        raise RecordingError(f"{damage(paths[first])}; {remedy}")

    def episodes(self, stage: Stage) -> list[Episode]:
        """Read all recorded episodes of a stage, in order. Raises RecordingError."""
        return [self.episode(stage, number) for number in range(self.count(stage))]

    def learned_from(self, first: int = 0) -> list[Episode]:
        """Read the recorded episodes that the learner gets, from number `first`: evaluations come first."""
        stages = (Stage.BEFORE, Stage.TUNE)
        paths = [self.path(stage, number) for stage in stages for number in range(self.count(stage))]
        return [read_recording(path).episode for path in paths[first:]]

    def write_episode(self, stage: Stage, number: int, episode: Episode) -> None:
        """Write an episode's recording."""
        length = self.config.plant.known_pole_length(self.config.emulator)
        header = {"stage": stage, "number": number, LENGTH: "" if length is None else f"{length:.4f}"}
        write_recording(self.path(stage, number), episode, header)

    def save(self, state: dict[str, Any], learned: int) -> None:
        """Write the checkpoint to resume from, after learning from `learned` episodes."""
        checkpoint = TrainingCheckpoint(self.config.model_dump(mode="json"), state, learned)
        save_training(self.folder, checkpoint, FINETUNING_FORMAT)


class FinetuningCart:
    """Drives episodes with `driver`, writes them to `files` and logs them, scored by `measure`, to `log`."""

    def __init__(self, driver: Driver, files: FinetuningFiles, log: TensorBoardLog, measure: Measure) -> None:
        self.driver, self.files, self.log, self.measure = driver, files, log, measure
        self.config = files.config
        self.link: LinkStatistics | None = None  # since the driver started; None before its first episode

    def evaluate(self, stage: Stage, weights: Weights) -> None:
        """Drive the episodes of a stage that are not on disk, without exploration.

        Raises the errors of `finish`.
        """
        while (number := self.files.count(stage)) < self.config.evaluation_episodes:
            self.start(weights, 0.0, self.config.seed)
            self.finish(stage, number)

    def start_tuning(self, number: int, weights: Weights) -> None:
        """Start episode `number` to learn from, with exploration, and return at once. Raises LinkError."""
        self.start(weights, self.config.finetuning.epsilon, self.config.seed + number)

    def start(self, weights: Weights, epsilon: float, seed: int) -> None:
        """Start an episode and return at once. Raises LinkError."""
        self.request = EpisodeRequest(weights, epsilon, seed)
        self.driver.start(self.request)

    def finish(self, stage: Stage, number: int) -> None:
        """Wait for the started episode, write and log it.

        An episode that does not count is driven again (`counts`). Raises LinkError if that happens
        LARGEST_LOSSES times in succession, and LearningError if the network's numbers were not finite: the
        cart was stopped.
        """
        for losses in range(1, LARGEST_LOSSES + 1):
            episode, self.link = self.driver.result()
            if episode.ended_by == Ending.NON_FINITE:
                raise LearningError(
                    f"{stage} {number + 1}: an observation or an action value was not finite, so the cart "
                    "was stopped; nothing is learned from this episode"
                )
            if counts(stage, episode):
                self.keep(stage, number, episode, self.link)
                return
            lost = f"{stage} {number + 1}: {ending_text(episode)}"
            if losses < LARGEST_LOSSES:
                print(f"{lost}; the episode does not count and is driven again", flush=True)
                self.driver.start(self.request)
        raise LinkError(f"{lost}, {losses} times in succession: check the cart's cables")

    def keep(self, stage: Stage, number: int, episode: Episode, link: LinkStatistics) -> None:
        """Write and log an episode."""
        self.files.write_episode(stage, number, episode)
        score, step = episode.total(self.measure), self.step(stage, number + 1)
        share = None if episode.guarded is None else float(episode.guarded.mean())
        self.log.scalars({f"cart/score_{stage}": score, f"cart/guarded_{stage}": share}, step)
        self.log.scalars({f"link/{key}": float(value) for key, value in link.summary().items()}, step)
        self.log.flush()
        ended = f"ended by {episode.ended_by}{guard_text(episode)}"
        print(f"{stage} {number + 1}: {self.measure} {score:z.0f}, {ended}", flush=True)

    def log_learning(self, curves: Mapping[str, float], learned: int) -> None:
        """Log curves at the step of the last episode that was learned from."""
        self.log.scalars(curves, self.step(Stage.TUNE, learned))

    def step(self, stage: Stage, number: int) -> int:
        """Return TensorBoard's step of a stage's episode `number`, from 1: the stages follow each other."""
        evaluations, episodes = self.config.evaluation_episodes, self.config.episodes
        return {Stage.BEFORE: 0, Stage.TUNE: evaluations, Stage.AFTER: evaluations + episodes}[stage] + number

    def link_summary(self) -> dict[str, Any]:
        """Return counts of lost, damaged and late frames, and the latency; empty before the first episode."""
        if self.link is None:
            return {}
        return {**self.link.summary(), "latency_override": self.link.latency_override()}


def damage(path: Path) -> str:
    """Return what is wrong with the recording in a file; empty if nothing is."""
    if not path.exists():
        return f"{path} is missing"
    try:
        read_recording(path)
    except RecordingError as error:
        return str(error)
    return ""


def counts(stage: Stage, episode: Episode) -> bool:
    """Return whether an episode is kept: one without a control period is not.

    Nor is an evaluation that the link or an encoder ended, which says nothing about the agent, or an episode
    to learn from that the link ended at once.
    """
    if stage is Stage.TUNE and episode.ended_by == Ending.LINK:
        return bool(episode.time[-1] - episode.time[0] >= SHORTEST)
    broken = stage is not Stage.TUNE and (episode.ended_by == Ending.LINK or episode.left_out)
    return bool(episode.steps and not broken)


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
