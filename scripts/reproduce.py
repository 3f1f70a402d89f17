"""Carry out the studies of the thesis and those beyond it; the same command continues after an interruption.

    scripts/reproduce --size quick                  everything, small: 20 to 30 minutes on two cores
    scripts/reproduce friction_models perturbations --size full --jobs 8
    scripts/reproduce --list                        names all studies

Each run has its folder, <folder>/<size>/<study>/<arm>/<seed>. Complete runs are skipped, an interrupted
training is resumed, an interrupted evaluation repeated. `cartpole-report studies=<folder>/<size>` shows the
results.
"""

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.files import FULL
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.workflows.person import as_word, exit_if_nobody_reads
from cartpole_rl.workflows.reproduce.process import SIGNALLED, reason_of
from cartpole_rl.workflows.reproduce.reproduce import reproduce
from cartpole_rl.workflows.studies import STUDIES, load_study, study_names

CHECKOUT = Path(__file__).resolve().parents[1]
RUNS = Path("runs/reproduce")  # in the checkout


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = argparse.ArgumentParser(
        "scripts/reproduce", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="studies (all)")
    parser.add_argument("--size", default="quick", help="quick (default) or full")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (one per core)")
    parser.add_argument("--folder", type=as_in_checkout, default=RUNS, help="of the results (runs/reproduce)")
    parser.add_argument("--studies", type=as_in_checkout, default=STUDIES, help="of studies (conf/study)")
    parser.add_argument("--list", action="store_true", help="name all studies and end")
    return parser.parse_args()


def as_in_checkout(path: str) -> Path:
    """Return a path of the caller's, as it is named in the checkout: everything runs there."""
    whole = Path.cwd() / path
    return whole.relative_to(CHECKOUT) if whole.is_relative_to(CHECKOUT) and whole != Path(path) else whole


def list_studies(source: Path) -> None:
    """Print a table: the name, the figure or section of the thesis and the question of each study."""
    studies = {name: load_study(name, source) for name in study_names(source)}
    rows = [(name, study.place, study.question) for name, study in studies.items()]
    rows = [("study", "figure or section", "question"), *rows]
    wide, middle = (max(len(row[column]) for row in rows) for column in (0, 1))
    for name, figure, question in rows:
        print(f"{name:{wide}}  {figure:{middle}}  {question}")


def check_options(names: Sequence[str], options: argparse.Namespace) -> None:
    """Raise ConfigError if no study has the size, or for fewer than one job."""
    if options.jobs < 1:
        raise ConfigError(f"--jobs {options.jobs}: give at least 1")
    sizes = dict.fromkeys(size for name in names for size in load_study(name, options.studies).sizes)
    if options.size not in sizes:
        raise ConfigError(f"--size {options.size}: give {' or '.join(sizes)}")


def interrupted(number: int) -> KeyboardInterrupt:
    """Return the exception that a signal raises."""
    return KeyboardInterrupt(number)


def run(options: argparse.Namespace, caller: Path) -> int:
    """Reproduce the chosen studies for a caller in a folder; return the exit code. Raises ConfigError."""
    root, source = options.folder / options.size, options.studies
    names = options.names or study_names(source)
    check_options(names, options)
    failures = reproduce(names, options.size, root, options.jobs, source, partial(print, flush=True))
    for label, reason in failures.items():
        print(f"scripts/reproduce: {label} failed: {reason}", file=sys.stderr)
    page = as_word("studies", root if caller == CHECKOUT else CHECKOUT / root)
    print(f"the page: cartpole-report {page}")
    return 1 if failures else 0


def main() -> int:
    """List the studies or reproduce them; return the exit code."""
    options, caller = parse_options(), Path.cwd()
    os.chdir(CHECKOUT)
    RaiseOnce(interrupted).handle(signal.SIGINT, *ending_signals())
    try:
        if options.list:
            list_studies(options.studies)
            return 0
        return run(options, caller)
    except ConfigError as error:
        print(f"scripts/reproduce: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        exit_if_nobody_reads()
        raise
    except OSError as error:
        remedy = "; make room, then give the same command again" if error.errno in FULL else ""
        print(f"scripts/reproduce: {reason_of(error)}{remedy}", file=sys.stderr)
        return CartPoleError.exit_code
    except KeyboardInterrupt as signalled:
        print("scripts/reproduce: interrupted; the same command continues", file=sys.stderr)
        return SIGNALLED + (signalled.args or (signal.SIGINT,))[0]


if __name__ == "__main__":
    sys.exit(main())
