"""Carries out a run of a study with the workflow of its command."""

import sys
import threading
from typing import Any

from tqdm import tqdm

from cartpole_rl.workflows.config import (
    EvaluateConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    TrainConfig,
)
from cartpole_rl.workflows.evaluate import evaluate
from cartpole_rl.workflows.finetune import finetune
from cartpole_rl.workflows.identify import identify_cart
from cartpole_rl.workflows.loading import load_settings
from cartpole_rl.workflows.model import learn_model
from cartpole_rl.workflows.reproduce.plan import Task
from cartpole_rl.workflows.run_folder import PREFIX
from cartpole_rl.workflows.train import train

WORKFLOWS: dict[str, tuple[type, Any]] = {
    "train": (TrainConfig, train),
    "evaluate": (EvaluateConfig, evaluate),
    "finetune": (FinetuneConfig, finetune),
    "identify": (IdentifyConfig, identify_cart),
    "model": (ModelConfig, learn_model),
}
tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which a killed process would leave


def carry_out(task: Task, resumed: bool = False) -> None:
    """Run the command of a task in its folder, or resume it. Raises CartPoleError."""
    sys.argv = [f"{PREFIX}{task.command}", *task.words]  # for provenance.json
    schema, workflow = WORKFLOWS[task.command]
    overrides = task.overrides | ({"resume": str(task.folder)} if resumed else {})
    workflow(load_settings(schema, overrides), task.folder)
