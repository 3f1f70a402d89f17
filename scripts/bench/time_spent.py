#!/usr/bin/env python
"""Where does the time of a training go?

    scripts/bench/time_spent.py experiment=medium --json time_spent.json

Runs cartpole-train with the given overrides to its end, in a temporary folder.

    stepping     collecting transitions: carts, acting policy, n-step returns, writing to replay
    updating     sampling and gradient steps
    evaluating   evaluations
    the rest     curves, pictures, checkpoints, progress
    compiling    the extra time of the first call of each of the first three, excluded from the shares
"""

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from common import option_parser, print_table, write_json

from cartpole_rl.agents.settings import AGENTS
from cartpole_rl.cli import run
from cartpole_rl.learning.dqn import Training

KINDS = {"collect": "stepping", "learn": "updating", "evaluate": "evaluating"}  # method of Training: kind
spent: dict[str, list[float]] = defaultdict(list)  # s, of each call


def timed(kind: str, work: Callable[..., Any]) -> Callable[..., Any]:
    """Return `work` with the seconds of each call added to `spent[kind]`."""

    def timing(*arguments: Any, **named: Any) -> Any:
        started = time.perf_counter()
        try:
            return work(*arguments, **named)
        finally:
            spent[kind].append(time.perf_counter() - started)

    return timing


class TimedTraining(Training):
    """A Training that measures its phases."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        for name, kind in KINDS.items():
            setattr(self, name, timed(kind, getattr(self, name)))

    def run(self) -> None:
        """Train to the end."""
        timed("all", super().run)()


def shares() -> dict[str, dict[str, float]]:
    """Return the seconds of each kind and their share of the time without compilation."""
    compiling = {kind: calls[0] - calls[1] for kind, calls in spent.items() if len(calls) > 1}
    seconds = {kind: sum(spent[kind]) - compiling.get(kind, 0.0) for kind in KINDS.values()}
    seconds["the rest"] = sum(spent["all"]) - sum(seconds.values()) - sum(compiling.values())
    total = sum(seconds.values())
    found = {kind: {"seconds": value, "share": value / total} for kind, value in seconds.items()}
    return {**found, "compiling": {"seconds": sum(compiling.values()), "share": 0.0}}


def main() -> None:
    """Train, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("overrides", nargs="*", help="overrides of cartpole-train")
    options = parser.parse_intermixed_args()
    dqn: Any = AGENTS.find("dqn")
    dqn.learner = TimedTraining
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["cartpole-train", *options.overrides, f"hydra.run.dir={folder}/run"]
        run("train")
    found = shares()
    print_table(
        [
            {"kind": kind, "seconds": f"{each['seconds']:.1f}", "share": f"{each['share']:.3f}"}
            for kind, each in found.items()
        ]
    )
    write_json(options.json, found)


if __name__ == "__main__":
    main()
