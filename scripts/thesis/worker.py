"""A run of a study as a process of its own, its results and its log. Imports nothing that takes long."""

import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Iterable
from contextlib import nullcontext, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

from plan import Task

from cartpole_rl.choices import choice
from cartpole_rl.errors import CartPoleError
from cartpole_rl.files import claimed
from cartpole_rl.reporting.results import EVALUATIONS
from cartpole_rl.run_folder import (
    CHECKPOINTS,
    COMPARISON,
    IDENTIFIED,
    INPUTS,
    LAST,
    LOG,
    METRICS,
    MODELLED,
    PREFIX,
    RESUME,
    file_hash,
    is_outdated,
    recorded_provenance,
    write_json,
)
from cartpole_rl.signals import RaiseOnce, ending_signals

COMMANDS = {  # command: the module and the function that carry it out, and its settings
    "train": ("cartpole_rl.workflows.train", "train", "TrainConfig"),
    "evaluate": ("cartpole_rl.workflows.evaluate", "evaluate", "EvaluateConfig"),
    "finetune": ("cartpole_rl.workflows.finetune", "finetune", "FinetuneConfig"),
    "identify": ("cartpole_rl.workflows.identify", "identify_cart", "IdentifyConfig"),
    "model": ("cartpole_rl.workflows.model", "learn_model", "ModelConfig"),
}
MODULES = [module for module, *_ in COMMANDS.values()]
RESUMABLE = ("train", "finetune")
RESULTS = {"identify": IDENTIFIED, "model": MODELLED, "finetune": COMPARISON}  # of the other commands METRICS
FOUND = (Path(CHECKPOINTS, LAST), Path(IDENTIFIED), Path(MODELLED))  # what other runs need
LONGEST = 1000  # characters of a reason: a pipe holds it until it is read
SIGNALLED = 128  # added to the number of a signal, as a shell does


def is_complete(task: Task) -> bool:
    """Return True for a run with all of its results, of the agent and the cart that are there now.

    An interrupted evaluation has only some episodes.
    """
    result = task.folder / RESULTS.get(task.command, METRICS)
    if task.command != "evaluate":
        has_results = result.is_file() and not is_unfinished(task)
    else:
        asked = task.overrides.get("episodes", choice("evaluate")["episodes"])
        try:
            has_results = len(json.loads(result.read_text(encoding="utf-8"))["episodes"]) == asked
        except (OSError, ValueError, LookupError, TypeError):
            has_results = False
    return has_results and not is_outdated(task.folder)


def is_unfinished(task: Task) -> bool:
    """Return True for a training or fine-tuning that was stopped: its last step removes this state."""
    return task.command in RESUMABLE and (task.folder / CHECKPOINTS / RESUME).is_file()


def made_otherwise(task: Task) -> str:
    """Return why a run does not belong to its study any more; empty if it does."""
    match recorded_provenance(task.folder).get("command"):
        case [_, *words] if task.was_made_by(words):
            return ""
    return "it was made with other settings; delete its folder to repeat it"


def in_own_process(task: Task, reasons: Connection) -> None:
    """Do what is left of a run. If it fails, send why, and exit with 1."""
    threading.Thread(target=_end_with_parent, name="parent watch", daemon=True).start()
    RaiseOnce(lambda number: KeyboardInterrupt()).handle(signal.SIGINT, *ending_signals())
    try:
        finish(task)
    except (Exception, KeyboardInterrupt) as error:
        with suppress(OSError):  # nobody is there any more
            reasons.send(reason_of(error)[:LONGEST])
        stopped = isinstance(error, KeyboardInterrupt)
        sys.exit(SIGNALLED + signal.SIGINT if stopped else CartPoleError.exit_code)


def _end_with_parent() -> None:
    """Send SIGTERM to this process when the one that asked for it has ended.

    A forked process has another parent for the system: the server that forks, which outlives that process.
    """
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def finish(task: Task) -> None:
    """Do what is left of a run, with everything that it prints in its log."""
    with claimed(task.folder):  # a process of a killed reproduction may still write into it
        resumed = prepare(task)
        if not resumed:
            write_inputs(task.folder, task.needs)
    # trainings and fine-tunings claim their folders themselves
    kept = nullcontext() if task.command in RESUMABLE else claimed(task.folder)
    with kept, (task.folder / LOG).open("a", encoding="utf-8") as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())
        try:
            carry_out(task, resumed)
            print(f"{sum(os.times()[:4]):.1f} s of computing time", flush=True)
        except BaseException as error:
            with suppress(OSError):  # of a full disk
                if isinstance(error, CartPoleError | OSError | KeyboardInterrupt):
                    print(f"\n{reason_of(error)}", flush=True)
                else:
                    traceback.print_exception(error)
            raise


def write_inputs(folder: Path, needs: Iterable[Path]) -> None:
    """Write the hashes of what the runs `needs` have found into the run folder."""
    files = [need / name for need in needs for name in FOUND if (need / name).is_file()]
    hashes = {Path(os.path.relpath(file, folder)).as_posix(): file_hash(file) for file in files}
    write_json(folder / INPUTS, hashes)


def prepare(task: Task) -> bool:
    """Remove an incomplete run that cannot be resumed; return True for one that can.

    The evaluations below an evaluation, which is that of the baseline, are runs of their own and stay.
    """
    command = recorded_provenance(task.folder).get("command")
    has_paths = isinstance(command, list) and command[1:] == [*task.words]  # it resumes with those of then
    if is_unfinished(task) and has_paths and not is_outdated(task.folder):
        return True
    for path in task.folder.glob("*"):
        if task.command == "evaluate" and path.name == EVALUATIONS:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    return False


def carry_out(task: Task, resumed: bool = False) -> None:
    """Run the command of a task in its folder, or resume it. Raises CartPoleError."""
    from tqdm import tqdm

    from cartpole_rl.workflows import config
    from cartpole_rl.workflows.config import load_settings

    tqdm.set_lock(threading.RLock())  # its own is a semaphore of the system, which a killed process leaves
    sys.argv = [f"{PREFIX}{task.command}", *task.words]  # for provenance.json
    module, function, schema = COMMANDS[task.command]
    settings = task.overrides | ({"resume": str(task.folder)} if resumed else {})
    getattr(import_module(module), function)(load_settings(getattr(config, schema), settings), task.folder)


def reason_of(error: BaseException) -> str:
    """Return why a run failed, in one line."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    text = " ".join(str(error).split())
    return text if isinstance(error, CartPoleError | OSError) else f"{type(error).__name__}: {text}"
