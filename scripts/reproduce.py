"""Carry out the studies of the thesis and those beyond it; the same command continues after an interruption.

    scripts/reproduce --size quick                  everything, small: under 30 minutes on two cores
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
from pathlib import Path

from cartpole_rl.errors import ConfigError
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.workflows.reproduce.studies import load_study, study_names


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = argparse.ArgumentParser(
        "scripts/reproduce", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="studies (all)")
    parser.add_argument("--size", default="quick", help="quick (default) or full")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (one per core)")
    parser.add_argument("--folder", type=Path, default=Path("runs/reproduce"), help="of the results")
    parser.add_argument("--list", action="store_true", help="name all studies and end")
    return parser.parse_args()


def list_studies() -> None:
    """Print the name, the figure and the question of each study."""
    for name in study_names():
        study = load_study(name)
        print(f"{name:28} {study.figure:18} {study.question}")


def main() -> int:
    """Reproduce; return the exit code."""
    options = parse_options()
    if options.list:
        list_studies()
        return 0
    from cartpole_rl.workflows.reproduce.reproduce import reproduce

    root = options.folder / options.size
    RaiseOnce(lambda number: KeyboardInterrupt()).handle(signal.SIGINT, *ending_signals())
    try:
        names = options.names or study_names()
        failures = reproduce(
            names, options.size, root, max(1, options.jobs), lambda line: print(line, flush=True)
        )
    except ConfigError as error:
        print(f"scripts/reproduce: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("scripts/reproduce: interrupted; the same command continues", file=sys.stderr)
        return 130
    for label, reason in failures.items():
        print(f"scripts/reproduce: {label} failed: {reason}", file=sys.stderr)
    print(f"results: cartpole-report studies={root}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
