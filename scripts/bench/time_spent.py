#!/usr/bin/env python
"""Where a training's time goes: stepping carts, updating the network, evaluating, and all the rest.

    scripts/bench/time_spent.py experiment=medium --json time_spent.json

The words are those of cartpole-train, which runs here to its end, in a folder that is thrown away. Stepping
is collecting from the carts, with the policy that acts, the n-step returns and their way into replay;
updating is sampling and the gradient steps. The rest is curves, pictures, checkpoints and progress. Compiling
is what the first of each takes longer than the next, and counts with none of them.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cartpole_rl.commands.train import main as train_command
from cartpole_rl.learning.training import Training
from cartpole_rl.reporting.table import table
from cartpole_rl.workflows import train

KINDS = {"collect": "stepping", "learn": "updating", "evaluate": "evaluating"}
spent: dict[str, list[float]] = defaultdict(list)  # s, of each call


def timed(kind: str, work: Callable[..., Any]) -> Callable[..., Any]:
    """`work`, whose time is noted under `kind`."""

    def timing(*arguments: Any, **named: Any) -> Any:
        started = time.perf_counter()
        try:
            return work(*arguments, **named)
        finally:
            spent[kind].append(time.perf_counter() - started)

    return timing


class TimedTraining(Training):
    """A Training that notes where its time goes."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        for name, kind in KINDS.items():
            setattr(self, name, timed(kind, getattr(self, name)))

    def run(self) -> None:
        """Train to the end."""
        timed("all", super().run)()


def shares() -> dict[str, dict[str, float]]:
    """Seconds of each kind, and their share of all without compilation."""
    compiling = {kind: calls[0] - calls[1] for kind, calls in spent.items() if len(calls) > 1}
    seconds = {kind: sum(spent[kind]) - compiling.get(kind, 0.0) for kind in KINDS.values()}
    seconds["the rest"] = sum(spent["all"]) - sum(seconds.values()) - sum(compiling.values())
    whole = sum(seconds.values())
    found = {kind: {"seconds": value, "share": value / whole} for kind, value in seconds.items()}
    return {**found, "compiling": {"seconds": sum(compiling.values()), "share": 0.0}}


def main() -> None:
    """Train, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", help="as for cartpole-train, as experiment=medium")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_intermixed_args()
    train.Training = TimedTraining  # type: ignore[misc]
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["cartpole-train", *given.words, f"hydra.run.dir={folder}/run"]
        train_command()
    found = shares()
    rows = [
        {"kind": kind, "seconds": f"{each['seconds']:.1f}", "share": f"{each['share']:.3f}"}
        for kind, each in found.items()
    ]
    print(table(rows, {key: key for key in rows[0]}))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
