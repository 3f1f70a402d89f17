"""The recordings of a fine-tuning in one order, and episodes as tensordicts."""

import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.ray_learner.offers import write_offer

POLL = 0.1  # s between two looks for the next recording
ENDINGS = list(Ending)
NUMBER, ENDED_BY = "number", "ended_by"


class EpisodeFiles:
    """The episodes that the learner gets, from 0: those before the tuning, then those to learn from."""

    def __init__(self, files: FinetuningFiles) -> None:
        self.files = files

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.files.folder

    def wait_for(self, number: int) -> TensorDictBase:
        """Return episode `number` as soon as it is on disk; never after the last one."""
        before = self.files.config.evaluation_episodes
        stage, own = (Stage.BEFORE, number) if number < before else (Stage.TUNE, number - before)
        while not self.files.path(stage, own).exists():
            time.sleep(POLL)
        return as_tensordict(number, self.files.episode(stage, own))

    def write_offer(self, packed: bytes) -> None:
        """Write weights that arrived, for the session to check and take."""
        write_offer(self.folder, packed)


def as_tensordict(number: int, episode: Episode) -> TensorDictBase:
    """Return an episode as tensors, with batch size [], and its number in the run."""
    arrays = {each.name: getattr(episode, each.name) for each in fields(Episode)}
    present = {name: torch.from_numpy(array) for name, array in arrays.items() if hasattr(array, "dtype")}
    labels = {NUMBER: torch.tensor(number), ENDED_BY: torch.tensor(ENDINGS.index(Ending(episode.ended_by)))}
    return TensorDict({**present, **labels}, batch_size=[])


def from_tensordict(tensors: TensorDictBase) -> Episode:
    """Return the episode of `as_tensordict`."""
    names = {each.name for each in fields(Episode)} - {ENDED_BY}
    arrays: dict[str, Any] = {name: tensors[name].numpy() for name in names & set(tensors.keys())}
    return Episode(**arrays, ended_by=str(ENDINGS[int(tensors[ENDED_BY])]))
