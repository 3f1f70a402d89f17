"""A run of a study as a process of its own, its results and its log. Imports nothing that takes long."""

import json
import os
import shutil
import signal
import sys
import traceback

from cartpole_rl.choices import choice
from cartpole_rl.errors import CartPoleError
from cartpole_rl.run_files import CHECKPOINTS, COMPARISON, IDENTIFIED, METRICS, MODELLED, RESUME
from cartpole_rl.signals import RaiseOnce, end_with_parent, ending_signals
from cartpole_rl.workflows.reproduce.plan import EVALUATIONS, Task
from cartpole_rl.workflows.run_folder import recorded_provenance
from cartpole_rl.workflows.run_inputs import is_outdated, write_inputs
from cartpole_rl.workflows.studies import overrides_of

LOG = "log.txt"
DEFAULT_EPISODES = choice("evaluate")["episodes"]
RESULTS = {"identify": IDENTIFIED, "model": MODELLED, "finetune": COMPARISON}  # of the other commands METRICS
RESUMABLE = ("train", "finetune")
SIGNALLED = 128  # added to the number of a signal, as a shell does


def is_complete(task: Task) -> bool:
    """Return True for a run with all of its results, of the agent and the cart that are there now.

    An interrupted evaluation has only some episodes.
    """
    return has_results(task) and not is_outdated(task.folder)


def has_results(task: Task) -> bool:
    """Return True for a run with all of its results."""
    result = task.folder / RESULTS.get(task.command, METRICS)
    if task.command != "evaluate":
        return result.is_file()
    asked = overrides_of(task.words).get("episodes", DEFAULT_EPISODES)
    try:
        return len(json.loads(result.read_text(encoding="utf-8"))["episodes"]) == asked
    except (OSError, ValueError, LookupError, TypeError):
        return False


def made_otherwise(task: Task) -> str:
    """Return why a run does not belong to its study any more; empty if it does."""
    match recorded_provenance(task.folder).get("command"):
        case [_, *words] if task.was_made_by(words):
            return ""
    return "it was made with other settings; delete its folder to repeat it"


def in_own_process(task: Task) -> None:
    """Do what is left of a run, with everything that it prints in its log. Exits with 1 if it fails."""
    end_with_parent(os.getppid())
    RaiseOnce(lambda number: KeyboardInterrupt()).handle(signal.SIGINT, *ending_signals())
    resumed = prepare(task)
    task.folder.mkdir(parents=True, exist_ok=True)
    if not resumed:
        write_inputs(task.folder, task.needs)
    with (task.folder / LOG).open("a", encoding="utf-8") as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())
        try:
            from cartpole_rl.workflows.reproduce.carry_out import carry_out

            carry_out(task, resumed)
        except (CartPoleError, OSError) as error:
            print(f"\n{' '.join(str(error).split())}", flush=True)
            sys.exit(CartPoleError.exit_code)
        except KeyboardInterrupt:
            print("\ninterrupted", flush=True)
            sys.exit(SIGNALLED + signal.SIGINT)
        except Exception:
            traceback.print_exc()
            sys.exit(CartPoleError.exit_code)
        print(f"{sum(os.times()[:4]):.1f} s of computing time", flush=True)


def prepare(task: Task) -> bool:
    """Remove an incomplete run that cannot be resumed; return True for one that can.

    The evaluations below an evaluation, which is that of the baseline, are runs of their own and stay.
    """
    can_resume = task.command in RESUMABLE and (task.folder / CHECKPOINTS / RESUME).is_file()
    command = recorded_provenance(task.folder).get("command")
    has_paths = isinstance(command, list) and command[1:] == [*task.words]  # it resumes with those of then
    if can_resume and has_paths and not is_outdated(task.folder):
        return True
    stays = EVALUATIONS if task.command == "evaluate" else None
    for path in task.folder.glob("*"):
        if path.is_dir() and path.name != stays:
            shutil.rmtree(path)
        elif not path.is_dir():
            path.unlink()
    return False
