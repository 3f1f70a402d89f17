"""Recordings and checkpoints of one fine-tuning in its run folder.

The recordings say how far a fine-tuning has come: what is on disk is not driven again.
"""

from enum import StrEnum
from pathlib import Path
from typing import Any

from cartpole_rl.evaluation.recordings import LENGTH, read_recording, write_recording
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    AgentCheckpoint,
    TrainingCheckpoint,
    forget_training,
    save_agent,
    save_training,
)
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.run_files import CHECKPOINTS, LAST, RECORDINGS, START
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import FinetuneConfig


class Stage(StrEnum):
    """Stages of a fine-tuning, in their order."""

    BEFORE = "before"  # evaluation of the trained agent
    TUNE = "tune"  # episodes to learn from
    AFTER = "after"  # evaluation of the fine-tuned agent


class FinetuningFiles:
    """Recordings and checkpoints in `folder`."""

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
        number = 0
        while self.path(stage, number).exists():
            number += 1
        return number

    def episode(self, stage: Stage, number: int) -> Episode:
        """Read an episode. Raises RecordingError."""
        return read_recording(self.path(stage, number))

    def episodes(self, stage: Stage) -> list[Episode]:
        """Read all recorded episodes of a stage, in order. Raises RecordingError."""
        return [self.episode(stage, number) for number in range(self.count(stage))]

    def write_episode(self, stage: Stage, number: int, episode: Episode) -> None:
        """Write an episode's recording."""
        length = pole_length(self.config)
        header = {"stage": stage, "number": number, LENGTH: "" if length is None else f"{length:.4f}"}
        write_recording(self.path(stage, number), episode, header)

    def save(self, state: dict[str, Any], episodes: int) -> None:
        """Write the checkpoint to resume from, after learning from `episodes` episodes."""
        checkpoint = TrainingCheckpoint(self.config.model_dump(mode="json"), state, episodes)
        save_training(self.folder, checkpoint, FINETUNING_FORMAT)

    def save_agent(self, agent: AgentCheckpoint) -> None:
        """Write the run's last agent, the one that other commands read."""
        save_agent(self.folder / CHECKPOINTS / LAST, agent)

    def forget_training(self) -> None:
        """Remove what only an unfinished fine-tuning needs."""
        forget_training(self.folder)
        self.start.unlink(missing_ok=True)


def pole_length(config: FinetuneConfig) -> float | None:
    """Return the length (m) of the pole on the cart; None if the settings do not state it."""
    plant = config.plant
    return plant.pole_length if isinstance(plant, SerialSettings) else 2 * config.emulator.pole_com
