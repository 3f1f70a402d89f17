"""Checks of settings that need no slow imports. Commands call them before they import a workflow.

`words` are the overrides on the command line. A workflow does not rely on these checks: it checks what it
reads.
"""

import os
import shutil
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from cartpole_rl.checking import missing
from cartpole_rl.choices import group_choices
from cartpole_rl.envs.settings import shipped_carts
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.identification.settings import ImportConfig, log_files, logs_in
from cartpole_rl.plants.settings import emulated_pole
from cartpole_rl.randomization.poles import Pole, PoleSettings, check_one_pole
from cartpole_rl.randomization.ranges import check_carts
from cartpole_rl.rig.hardware import check_track, parameters_of
from cartpole_rl.rig.parameters import check_names, check_value, check_values, completed
from cartpole_rl.run_folder import (
    BASELINE,
    CHECKPOINTS,
    LAST,
    METRICS,
    PREFIX,
    RESUME,
    check_program,
    experiments,
    find_agent,
    find_training,
    has_ended,
    is_own_policy,
    program_of,
    recordings,
    use_of,
)
from cartpole_rl.terminal import as_value, as_word, print_message
from cartpole_rl.workflows.config import (
    DistillConfig,
    EvaluateConfig,
    ExportConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    ReplayConfig,
    TrainConfig,
)
from cartpole_rl.workflows.poles import lengths

LARGEST_BATCH = 1024  # carts that an evaluation simulates at once
LONGER = {  # command: how to train further than a run that has ended
    "train": "cartpole-train with more learning.transitions makes a longer training",
    "finetune": "cartpole-finetune run={0} trains it further",
}


PACKAGES = {  # extra of this package: its modules, and their names
    "export": {"onnx": "onnx", "onnxscript": "onnxscript"},
    "mcap": {"mcap": "mcap"},
    "minari": {"minari": "minari", "h5py": "h5py"},
    "parquet": {"pyarrow": "PyArrow"},
    "ray": {"ray": "Ray"},
    "video": {"av": "PyAV"},
}
EXTRAS = {"onnx": "export", "minari": "minari", "mcap": "mcap"}  # of formats
SIMILAR_MASS = 0.2  # share by which an emulated pole may differ from the stated one
MINARI_FILE = "main_data.hdf5"
TAKEN_BY_REPEAT = ("run", "repeat.run", "repeat.episode", "label", "view")
# by a fine-tuning: where its learner is, how its cart is reached
TAKEN_BY_RESUME = ("resume", "learner", "view", "plant.port", "plant.clear_faults", "plant.home_timeout")


def check_training(config: TrainConfig, folder: Path, words: Sequence[str]) -> None:
    """Raise CartPoleError if a training cannot start, or the run of `resume` cannot continue."""
    if config.resume is not None:
        refuse_others(words, ("resume",), "resume uses that run's own config")
        return check_resumable("train", config.resume, folder)
    config.check_learning()
    if config.compile:
        check_compiler()
    check_track(config.cart)
    check_carts(config.nominal_cart, config.pole, config.ranges)
    config.plant.check()
    return None


def check_evaluation(config: EvaluateConfig, words: Sequence[str]) -> None:
    """Raise CartPoleError if the agent, the cart or the episode to repeat does not exist."""
    check_track(config.cart or {})
    check_repetition(config, words)
    if config.run != BASELINE and not is_own_policy(config.run):
        check_agent(config.run)
    elif config.run.suffix == ".onnx" and not config.run.is_file():
        raise CheckpointError(f"run={config.run}: there is no such file; give an ONNX model")
    elif config.drives_on_board:
        raise ConfigError(
            f"run={config.run}: only a trained agent can drive on the board; give its run folder"
        )
    config.plant.check()
    check_stated_pole(config.pole, config, "leave plant.pole_length or pole= out, or mend one of them")
    check_parameters(config.parameters or {})
    if config.animation.mp4:
        check_installed("animation.mp4=true", "video")


def check_repetition(config: EvaluateConfig, words: Sequence[str]) -> None:
    """Raise ConfigError where other settings are given, or there is no such episode."""
    if config.repeat.run is None and config.repeat.episode is None:
        return
    if config.repeat.run is not None:
        refuse_others(words, TAKEN_BY_REPEAT, "repeat uses that evaluation's own settings")
    from cartpole_rl.workflows.episodes import repetition  # imports PyTorch

    repetition(config)


def check_tuning(config: FinetuneConfig, folder: Path, words: Sequence[str]) -> None:
    """Raise CartPoleError if a fine-tuning cannot start, or the run of `resume` cannot continue."""
    if config.resume is None:
        check_finetuning(config)
    else:
        refuse_others(words, TAKEN_BY_RESUME, "resume uses that run's own config")
        check_resumable("finetune", config.resume, folder)


def check_finetuning(config: FinetuneConfig) -> Path:
    """Return the run to fine-tune. Raises CartPoleError if it has no agent."""
    if config.run is None:
        raise ConfigError(f"{missing('run')}, or resume=runs/finetune/<run> to continue a fine-tuning")
    check_agent(config.run)
    check_tools(config)
    return config.run


def check_tools(config: FinetuneConfig) -> None:
    """Raise ConfigError if what a fine-tuning compiles or learns with is not installed."""
    if config.compile:
        check_compiler()
    if config.learner.kind == "ray":
        check_installed("learner=ray", "ray", where=", on both machines")


def check_distillation(config: DistillConfig) -> None:
    """Raise CartPoleError if there is no agent."""
    check_agent(config.run)


def check_export(config: ExportConfig) -> None:
    """Raise CartPoleError if there is nothing to export, or what writes the format is not installed."""
    if config.run is not None:
        check_agent(config.run)
    if config.source is not None:
        recordings(config.source)
    if extra := EXTRAS.get(config.format):
        check_installed(f"format={config.format}", extra)


def check_import(config: ImportConfig, words: Sequence[str]) -> None:
    """Raise CartPoleError if there is no log or recording, or what reads it is not installed."""
    form, _ = exported_recordings(config.source)
    if form is None:
        log_files(config)
        return
    refuse_others(words, ("from", "label"), f"from={config.source}: a recording has its own layout and cart")
    check_installed(f"from={config.source}", form)


def check_installed(setting: str, extra: str, where: str = "") -> None:
    """Raise ConfigError if a package of an extra of ours, which `setting` needs, is not installed."""
    needed = PACKAGES[extra]
    if any(find_spec(module) is None for module in needed):
        words = " and ".join(needed.values())
        raise ConfigError(f'{setting} needs {words}: pip install "cartpole_rl[{extra}]"{where}')


def exported_recordings(source: Path) -> tuple[str | None, list[Path]]:
    """Return the format of what `source` holds of cartpole-export, None for logs, and its places.

    `source` is a file, a folder of files without logs, the folder of a data set of Minari or its name there.
    """
    own = Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari/datasets") / source
    for data in (source, source / "data", *source.glob("cartpole_rl/*/data"), own / "data"):
        if (data / MINARI_FILE).is_file():
            return "minari", [data]
    files = [source] if source.suffix == ".mcap" and source.is_file() else sorted(source.glob("*.mcap"))
    if logs_in(source):  # a bag of ROS 2 may stand beside them
        files = []
    return ("mcap" if files else None), files


def check_replay(config: ReplayConfig) -> None:
    """Raise CartPoleError if there is no recording, or the cart or its pole is impossible."""
    recordings(config.source)
    if config.pole is not None:
        check_one_pole("a replay", config.pole)
    check_track(config.cart or {})
    check_parameters({**parameters_of(config.cart or {}), **(config.parameters or {})})


def check_modelling(config: ModelConfig) -> None:
    """Raise CartPoleError if there is no recording, or more than one pole is chosen."""
    for source in config.source:
        recordings(source)
    if config.pole is not None:
        check_one_pole("a model", config.pole)


def check_identification(config: IdentifyConfig) -> None:
    """Raise CartPoleError if the prior cart is impossible, or there is no recording."""
    check_values(config.nominal)
    check_track(config.cart)
    if config.source is not None:
        experiments(config.source)
    elif config.plant.reads_emulator:
        check_emulated_pole(config)
    else:
        check_stated_pole(
            config.pole, config, "give the pole on the cart as pole=, or mend plant.pole_length"
        )


def check_stated_pole(
    pole: PoleSettings | None, config: EvaluateConfig | IdentifyConfig, remedy: str
) -> None:
    """Raise ConfigError, with a remedy, if pole= and plant.pole_length state two poles on a real cart."""
    length = None if config.plant.reads_emulator else config.plant.known_pole_length(config.emulator)
    if pole is not None and length is not None and not pole.includes(Pole.rod(length)):
        raise ConfigError(
            f"plant.pole_length={length:g}: pole={pole.name} has the centre of mass of a rod of "
            f"{lengths(pole)}; {remedy}"
        )


def check_emulated_pole(config: IdentifyConfig) -> None:
    """Raise ConfigError if the emulated cart has another pole than the one that is stated."""
    stated, carried = config.pole.nominal, emulated_pole(config.emulator)
    if stated.is_about(carried.length) and abs(stated.pole_mass / carried.pole_mass - 1) < SIMILAR_MASS:
        return
    words = " ".join(f"emulator.{name}={value:g}" for name, value in stated)
    raise ConfigError(
        f"pole: it has {stated.length:.3g} m and {stated.pole_mass:.3g} kg, and the emulated cart carries "
        f"one of {carried.length:.3g} m and {carried.pole_mass:.3g} kg; give that as pole=, or {words}"
    )


def check_resumable(program: str, resume: str, folder: Path) -> None:
    """Raise CartPoleError if cartpole-<program> cannot resume the run `resume` in `folder`."""
    run = Path(resume)
    check_program("resume", run, program)
    if run.is_dir() and not (folder.exists() and folder.samefile(run)):
        raise ConfigError("resume continues in that run's own folder; leave out hydra.run.dir")
    if has_ended(run):
        raise ConfigError(
            f"resume={run}: this run of {PREFIX}{program} has ended; cartpole-evaluate "
            f"{as_word('run', run)} drives its agent, {LONGER[program].format(as_value(run))}"
        )
    find_training(run)


def refuse_others(words: Iterable[str], allowed: Collection[str], reason: str) -> None:
    """Raise ConfigError that names the settings given on the command line beside those `allowed`."""
    if others := [word for word in words if not is_given(allowed, [word])]:
        raise ConfigError(f"{reason}; leave out {', '.join(others)}")


def is_given(settings: Collection[str], words: Iterable[str]) -> bool:
    """Return True if one of the `words` gives one of the settings, or chooses or sets something in it."""
    keys = {word.lstrip("+~").partition("=")[0] for word in words}
    return not {*keys, *(key.partition(".")[0] for key in keys)}.isdisjoint(settings)


def check_agent(run: Path) -> None:
    """Raise ConfigError or CheckpointError if `run` is not a run folder or file with an agent."""
    if run == BASELINE:
        raise ConfigError(
            f"run={BASELINE}: the baseline has no network; give a training, such as run=pretrained/medium"
        )
    if is_own_policy(run):
        raise ConfigError(
            f"run={run}: only cartpole-evaluate and cartpole-record drive a policy of your own; give a "
            "training, such as run=pretrained/medium"
        )
    check_has_agent(run)
    find_agent(run)


def agent_file(run: Path) -> Path | None:
    """Return the checkpoint or ONNX file of an agent; None without one. Raises CheckpointError."""
    if run.suffix == ".onnx":
        return run
    return None if run == BASELINE or is_own_policy(run) else find_agent(run)


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
    again = f"start {PREFIX}{program} again"
    if (run / CHECKPOINTS / RESUME).exists():
        again = f"{PREFIX}{program} {as_word('resume', run)} continues it"
    raise ConfigError(f"run={run}: it holds no {CHECKPOINTS}/{LAST}; the file was removed; {again}")


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


def note_other_numbers(command: str, cart: Mapping[str, float], poles: Iterable[Pole]) -> None:
    """Print the numbers that are those of no cart or pole in conf/, and which the most similar one has."""
    found = min(([*differences(cart, completed(each))] for each in shipped_carts()), key=len)
    for pole in poles:
        found += differences(pole.model_dump(), nominal_pole(pole).model_dump())
    if found:
        print_message(command, f"note: no cart in conf/ has these numbers: {', '.join(found)}")


def differences(numbers: Mapping[str, float], nominal: Mapping[str, float]) -> Iterator[str]:
    """Yield a text for each of the `numbers` that is not the nominal one."""
    for name, value in numbers.items():
        if value != nominal.get(name):
            yield f"{name} {value:.4g}" + (f" instead of {nominal[name]:g}" if name in nominal else "")


def nominal_pole(pole: Pole) -> Pole:
    """Return the pole in conf/ whose length is nearest to that of `pole`."""
    shipped = (
        Pole(**each) for found in group_choices("pole").values() for each in found.get("choices", {}).values()
    )
    return min(shipped, key=lambda each: abs(each.length - pole.length))
