"""Settings with which each command of a page takes seconds, and how to run its Python blocks with them."""

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from cartpole_rl.settings import Settings
from cartpole_rl.workflows import config as configs
from cartpole_rl.workflows.config import (
    EvaluateConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    RecordConfig,
    TrainConfig,
)

TOY: dict[type[Settings], dict[str, Any]] = {
    TrainConfig: {
        "learning.transitions": 1024,
        "learning.carts": 16,
        "learning.chunk": 8,
        "learning.updates": 1,
        "learning.batch_size": 16,
        "learning.warmup_transitions": 64,
        "learning.evaluations": 1,
        "learning.evaluation_episodes": 2,
        "buffer.size": 2000,
        "task.time_limit": 100,
        "compile": False,
    },
    EvaluateConfig: {"episodes": 2},
    RecordConfig: {"episodes": 2, "task": "swingup", "task.time_limit": 400},
    ModelConfig: {
        "windows": 10,
        "ensemble.members": 2,
        "ensemble.hidden": 4,
        "ensemble.updates": 2,
        "ensemble.refresh": 1,
    },
    IdentifyConfig: {"windows": 20, "substeps": 2, "carts": 20},
    FinetuneConfig: {
        "episodes": 1,
        "evaluation_episodes": 1,
        "finetuning.iterations": 1,
        "emulator.physics_step": 1e-3,
        "compile": False,
    },
}


def work_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `folder` the working directory, in which settings are of toy size."""
    load = configs.load_settings

    def load_toy(schema: type[Settings], overrides: Mapping[str, Any]) -> Settings:
        return load(schema, {**overrides, **TOY.get(schema, {})})

    monkeypatch.setattr(configs, "load_settings", load_toy)
    monkeypatch.chdir(folder)


def run_block(block: str, page: Path, names: dict[str, Any]) -> str:
    """Run a Python block of a page, which reads and changes `names`; return what it printed."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(compile(block, page.name, "exec"), names)
    return output.getvalue()
