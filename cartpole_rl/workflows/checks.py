"""Checks of settings that need no slow imports. Commands call them before they import a workflow.

A workflow does not rely on them: it checks what it reads.
"""

import os
import shutil
import sys
import sysconfig
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from cartpole_rl.checking import missing
from cartpole_rl.errors import ConfigError
from cartpole_rl.learning.checkpoint_files import find_agent, find_training
from cartpole_rl.plants.model_file import find_model
from cartpole_rl.plants.settings import LearnedSettings
from cartpole_rl.randomization.poles import check_one_pole
from cartpole_rl.randomization.ranges import check_carts
from cartpole_rl.rig.parameters import check_names, check_value, check_values
from cartpole_rl.run_files import CHECKPOINTS, LAST, METRICS, RESUME
from cartpole_rl.workflows.config import (
    EvaluateConfig,
    ExportConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    ReplayConfig,
    TrainConfig,
)
from cartpole_rl.workflows.person import as_value, as_word
from cartpole_rl.workflows.recordings import experiments, recordings
from cartpole_rl.workflows.run_folder import PREFIX, check_program, has_ended, program_of, use_of

BASELINE = Path("lqr")  # run=lqr is energy and LQR, not a folder
LARGEST_BATCH = 1024  # carts that an evaluation simulates at once
LONGER = {  # command: how to train further than a run that has ended
    "train": "cartpole-train with more learning.transitions makes a longer training",
    "finetune": "cartpole-finetune run={0} trains it further",
}


def check_training(config: TrainConfig) -> None:
    """Raise CartPoleError if a new training cannot start."""
    if config.compile:
        check_compiler()
    check_carts(config.nominal_cart, config.pole, config.ranges)
    if isinstance(config.plant, LearnedSettings):
        check_model(config.plant)


def check_evaluation(config: EvaluateConfig) -> None:
    """Raise CartPoleError if the agent or the cart does not exist."""
    if config.run != BASELINE:
        check_agent(config.run)
    elif config.drives_on_board:
        raise ConfigError(f"run={BASELINE}: only a trained agent can drive on the board; give its run folder")
    if isinstance(config.plant, LearnedSettings):
        check_model(config.plant)
    check_parameters(config.parameters or {})
    if config.animation.mp4 and find_spec("av") is None:
        raise ConfigError('animation.mp4=true needs PyAV: pip install "cartpole_rl[video]"')


def check_finetuning(config: FinetuneConfig) -> Path:
    """Return the run to fine-tune. Raises CartPoleError if it has no agent."""
    if config.run is None:
        raise ConfigError(missing("run"))
    if config.compile:
        check_compiler()
    check_agent(config.run)
    check_ray(config)
    return config.run


def check_ray(config: FinetuneConfig) -> None:
    """Raise ConfigError if the settings need Ray, and it is not installed."""
    if config.learner.kind == "ray" and find_spec("ray") is None:
        raise ConfigError('learner=ray needs Ray: pip install "cartpole_rl[ray]", on both machines')


def check_export(config: ExportConfig) -> None:
    """Raise CartPoleError if there is no agent, or what writes the format is not installed."""
    check_agent(config.run)
    if config.format == "onnx" and (find_spec("onnx") is None or find_spec("onnxscript") is None):
        raise ConfigError('format=onnx needs onnx and onnxscript: pip install "cartpole_rl[export]"')


def check_replay(config: ReplayConfig) -> None:
    """Raise CartPoleError if there is no recording, or the cart or its pole is impossible."""
    recordings(config.source)
    if config.pole is not None:
        check_one_pole("a replay", config.pole)
    check_names(config.nominal_cart)
    check_parameters({**config.nominal_cart, **(config.parameters or {})})


def check_modelling(config: ModelConfig) -> None:
    """Raise CartPoleError if there is no recording, or more than one pole is chosen."""
    for source in config.source:
        recordings(source)
    if config.pole is not None:
        check_one_pole("a model", config.pole)


def check_identification(config: IdentifyConfig) -> None:
    """Raise CartPoleError if the prior cart is impossible, or there is no recording."""
    check_values(config.nominal)
    if config.source is not None:
        experiments(config.source)


def check_resumable(program: str, resume: str, folder: Path) -> None:
    """Raise CartPoleError if cartpole-<program> cannot resume the run `resume` in `folder`."""
    run = Path(resume)
    check_program("resume", run, program)
    if run.is_dir() and not folder.samefile(run):
        raise ConfigError("resume continues in that run's own folder; leave out hydra.run.dir")
    if has_ended(run):
        raise ConfigError(
            f"resume={run}: this run of {PREFIX}{program} has ended; cartpole-evaluate "
            f"{as_word('run', run)} drives its "
            f"agent, {LONGER[program].format(as_value(run))}"
        )
    find_training(run)


def check_agent(run: Path) -> None:
    """Raise ConfigError or CheckpointError if `run` is not a run folder or file with an agent."""
    if run == BASELINE:
        raise ConfigError(
            f"run={BASELINE}: the baseline has no network; give a training, such as run=pretrained/medium"
        )
    check_has_agent(run)
    find_agent(run)


def agent_file(run: Path) -> Path | None:
    """Return the checkpoint of an agent; None for the baseline. Raises CheckpointError."""
    return None if run == BASELINE else find_agent(run)


def check_has_agent(run: Path) -> None:
    """Raise ConfigError if `run` is a run folder without an agent."""
    check_program("run", run, "train", "finetune", "distill")
    program = program_of(run)
    if program is None or (run / CHECKPOINTS / LAST).exists():
        return
    if not (run / METRICS).exists():
        raise ConfigError(
            f"run={run}: this run of {PREFIX}{program} has no agent yet; {use_of(run, program)}"
        )
    can_resume = (run / CHECKPOINTS / RESUME).exists()
    again = (
        f"{PREFIX}{program} {as_word('resume', run)} continues it"
        if can_resume
        else f"start {PREFIX}{program} again"
    )
    raise ConfigError(f"run={run}: it holds no {CHECKPOINTS}/{LAST}; the file was removed; {again}")


def check_model(plant: LearnedSettings) -> None:
    """Raise CheckpointError or ConfigError if plant.model= names no learned model."""
    check_program("plant.model", plant.model, "model")
    find_model(plant.model)


def check_parameters(given: Mapping[str, float]) -> None:
    """Raise ConfigError for an unknown name in `parameters` or an impossible value."""
    check_names(given, "parameters")
    for name, value in given.items():
        check_value(name, value)


def simulated_carts(config: EvaluateConfig) -> int:
    """Return how many carts an evaluation simulates at once: one for each episode, up to LARGEST_BATCH."""
    return min(config.episodes, LARGEST_BATCH)


def check_compiler(device: str = "cpu") -> None:
    """Raise ConfigError if torch.compile lacks a C++ compiler, a header of Python or, for a GPU, Triton."""
    compiler = os.environ.get("CXX", {"darwin": "clang++", "win32": "cl"}.get(sys.platform, "g++"))
    header = Path(sysconfig.get_path("include"), "Python.h")
    if shutil.which(compiler) is None:
        raise ConfigError(f"compile=true finds no C++ compiler {compiler}: install it, or give compile=false")
    if not header.exists():
        raise ConfigError(f"compile=true finds no {header}: install Python's headers, or give compile=false")
    if device == "cuda" and find_spec("triton") is None:
        raise ConfigError("compile=true with device=cuda needs Triton: install it, or give compile=false")
