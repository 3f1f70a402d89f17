#!/usr/bin/env python
"""How well do small networks drive that are distilled from agents? Rows of docs/exporting.md.

    scripts/bench/distillation.py runs/bench/medium/1[0-2] --hidden 32,32 16,16 --json students.json

Distills each agent into a network of each size, in runs/bench/distilled/<agent>_<sizes>; one that exists is
not distilled again, and refused if other words made it. Words such as distillation.updates=1000 are passed to
cartpole-distill as overrides; with other ones give another --folder.
Prints the figures of the agents, then those of the students: the mean score over 100 starts on the nominal
simulated cart; the mean over a thousand carts of randomization=wide, and the share of them that failed
(learning.py); memory and multiply-adds of the exported C.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import RUNS, option_parser, positive_int, print_table, processes, run_once, write_json
from learning import judge

from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.workflows.build import TrainedAgent, exported_agent, trained_agent

COSTS = {"table bytes": r"(\d+) bytes of tables", "multiply-adds": r"(\d+) multiply-adds"}  # in policy.h


def sizes(text: str) -> tuple[int, ...]:
    """Convert `--hidden` to units of each layer."""
    return tuple(map(positive_int, text.split(",")))


def costs(agent: TrainedAgent) -> dict[str, Any]:
    """Return what an agent costs on a processor."""
    header = c_files(exported_agent(agent, {}), agent.training)["policy.h"]
    found = {name: re.search(pattern, header) for name, pattern in COSTS.items()}
    hidden = ", ".join(map(str, agent.training.agent.hidden))
    return {"hidden": hidden, **{name: int(match[1]) for name, match in found.items() if match}}


def figures(run: Path, pole: str) -> dict[str, Any]:
    """Return the scores of an agent, and what it costs on a processor."""
    return {"agent": run.name, **costs(trained_agent(run)), **judge(run, pole, "wide")}


def student_figures(
    teacher: Path, hidden: tuple[int, ...], parent: Path, words: Sequence[str], pole: str
) -> dict[str, Any]:
    """Distill, unless it was done, and judge."""
    units = [*map(str, hidden)]
    folder = parent / "_".join([teacher.name, *units])
    layers = f"hidden=[{','.join(units)}]"
    return figures(run_once(folder, "distill", f"run={teacher}", layers, *words), pole)


def main() -> None:
    """Distill, judge, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("runs", nargs="+", help="run folders of agents, the teachers")
    parser.add_argument(
        "--hidden", nargs="+", type=sizes, default=[(32, 32), (16, 16)], metavar="UNITS,UNITS"
    )
    parser.add_argument("--pole", default="medium", help="on which they are judged (medium)")
    parser.add_argument("--folder", type=Path, default=RUNS / "distilled", help="of the students' runs")
    parser.add_argument("--jobs", type=positive_int, default=1, help="distillations at the same time (1)")
    options, words = parser.parse_known_args()
    runs = [Path(word) for word in options.runs if "=" not in word]
    words += [word for word in options.runs if "=" in word]
    with processes(options.jobs) as pool:
        pending = [pool.submit(figures, run, options.pole) for run in runs]
        for hidden in options.hidden:
            for run in runs:
                pending.append(pool.submit(student_figures, run, hidden, options.folder, words, options.pole))
        results = [each.result() for each in pending]
    print_table(
        [{key: f"{value:.3g}" if key == "failed" else value for key, value in row.items()} for row in results]
    )
    write_json(options.json, results)


if __name__ == "__main__":
    main()
