"""Settings with which each command of a page takes seconds."""

from typing import Any

from cartpole_rl.settings import Settings
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
