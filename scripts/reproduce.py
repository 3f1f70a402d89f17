"""Carry out the studies of the thesis and those beyond it; the same command continues after an interruption.

    scripts/reproduce --size quick                  everything, small: about 20 minutes on two cores
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
from functools import partial
from pathlib import Path

from cartpole_rl.errors import ConfigError
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.workflows.reproduce.process import SIGNALLED
from cartpole_rl.workflows.reproduce.reproduce import reproduce
from cartpole_rl.workflows.studies import STUDIES, load_study, study_names


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = argparse.ArgumentParser(
        "scripts/reproduce", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="studies (all)")
    parser.add_argument("--size", default="quick", help="quick (default) or full")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (one per core)")
    parser.add_argument("--folder", type=Path, default=Path("runs/reproduce"), help="of the results")
    parser.add_argument("--studies", type=Path, default=STUDIES, help="folder of the studies (conf/study)")
    parser.add_argument("--list", action="store_true", help="name all studies and end")
    return parser.parse_args()


def list_studies(source: Path) -> None:
    """Print the name, the figure and the question of each study."""
    for name in study_names(source):
        study = load_study(name, source)
        print(f"{name:28} {study.figure:18} {study.question}")


def interrupted(number: int) -> KeyboardInterrupt:
    """Return the exception that a signal raises."""
    return KeyboardInterrupt(number)


def run(options: argparse.Namespace) -> int:
    """Reproduce the chosen studies; return the exit code. Raises ConfigError."""
    root, source = options.folder / options.size, options.studies
    names = options.names or study_names(source)
    failures = reproduce(names, options.size, root, max(1, options.jobs), source, partial(print, flush=True))
    for label, reason in failures.items():
        print(f"scripts/reproduce: {label} failed: {reason}", file=sys.stderr)
    print(f"the page: cartpole-report studies={root}")
    return 1 if failures else 0


def main() -> int:
    """List the studies or reproduce them; return the exit code."""
    options = parse_options()
    RaiseOnce(interrupted).handle(signal.SIGINT, *ending_signals())
    try:
        if options.list:
            list_studies(options.studies)
            return 0
        return run(options)
    except ConfigError as error:
        print(f"scripts/reproduce: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt as signalled:
        print("scripts/reproduce: interrupted; the same command continues", file=sys.stderr)
        return SIGNALLED + (signalled.args or (signal.SIGINT,))[0]


if __name__ == "__main__":
    sys.exit(main())
