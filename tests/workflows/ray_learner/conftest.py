"""A short fine-tuning with a learner elsewhere, its files, and an episode."""

from pathlib import Path

import numpy as np
import pytest

from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import FinetuneConfig
from cartpole_rl.workflows.finetuning_files import FinetuningFiles
from cartpole_rl.workflows.loading import load_settings


@pytest.fixture(scope="session")
def short_episode() -> Episode:
    return Episode(
        time=0.02 * np.arange(3),
        x=np.array([0.0, 0.1, 1 / 3]),
        x_dot=np.zeros(3),
        theta=np.full(3, np.pi),
        theta_dot=np.zeros(3),
        counts=np.arange(6).reshape(3, 2),
        motor=np.array([100, -100]),
        score=np.ones(2),
        score_upright=np.ones(2),
        reward=np.ones(2),
        ended_by="fault",
        guarded=np.array([True, False]),
    )


@pytest.fixture
def files(tmp_path: Path) -> FinetuningFiles:
    overrides = {
        "run": "somewhere",
        "learner": "ray",
        "learner.address": "learner:6379",
        "learner.episodes_ahead": 2,
        "episodes": 4,
        "evaluation_episodes": 1,
    }
    return FinetuningFiles(tmp_path, load_settings(FinetuneConfig, overrides))
