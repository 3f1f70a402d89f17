#!/usr/bin/env python
"""How do the time and the memory of a report grow with the number of run folders?

    scripts/bench/reports.py runs/train/<run> --runs 100 1000 10000 --json reports.json

Copies the run with other seeds, values of `--setting` and scores into a temporary folder, and makes a report
of the copies with cartpole-report. Pictures and checkpoints are hard links, so that copies take little room.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common import option_parser, positive_int, print_table, write_json

from cartpole_rl.run_folder import CONFIG, HISTORY, METRICS, PAGE, PROVENANCE

REWRITTEN = (CONFIG, PROVENANCE, METRICS, HISTORY)
# a small process starts the command: a peak counts the memory of the process that was forked
PEAK = """import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_maxrss, used.ru_utime + used.ru_stime)"""  # kB, s
SEEDS = 3  # of each set-up
SCORES = 101  # different ones


def copy_run(run: Path, copy: Path, setting: str, number: int) -> None:
    """Copy the files of `run` as those of the run with this number: another seed, setting and score."""
    seed, value = number % SEEDS, round(1e-4 * (1 + number // SEEDS), 4)
    texts = {name: (run / name).read_text() for name in REWRITTEN if (run / name).exists()}
    texts[CONFIG] = re.sub(r"(?m)^seed: .*", f"seed: {seed}", texts[CONFIG])
    texts[CONFIG] = re.sub(rf"(?m)^(\s*{setting}): \S+$", rf"\1: {value}", texts[CONFIG])
    metrics = json.loads(texts[METRICS])
    metrics["score"]["mean"] = 40.0 * (number % SCORES)
    texts[METRICS] = json.dumps(metrics, indent=2)
    for file in filter(Path.is_file, run.rglob("*")):
        place = copy / file.relative_to(run)
        place.parent.mkdir(parents=True, exist_ok=True)
        if file.name in texts:
            place.write_text(texts[file.name])
        else:
            os.link(file, place)


def measured(runs: Path, report: Path, words: list[str]) -> dict[str, Any]:
    """Make a report of the folder `runs`; return its times, its peak memory and the size of its page."""
    program = str(Path(sys.executable).with_name("cartpole-report"))
    command = [program, f"runs={runs}", f"hydra.run.dir={report}"]
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", PEAK, *command, *words], check=True, stdout=subprocess.PIPE)
    peak, processor = done.stdout.split()
    return {
        "seconds": round(time.perf_counter() - start, 1),
        "processor_s": round(float(processor), 1),
        "peak_mb": int(peak) // 1000,
        "page_mb": round((report / PAGE).stat().st_size / 1e6, 2),
    }


def options() -> argparse.Namespace:
    """Return the words of the command line."""
    parser = option_parser(__doc__)
    parser.add_argument("run", type=Path, help="a run folder, on the disk of runs/")
    parser.add_argument("words", nargs="*", help="further settings of cartpole-report")
    parser.add_argument("--runs", type=positive_int, nargs="+", default=[100, 1000, 10000], metavar="N")
    parser.add_argument("--setting", default="learning_rate", help="the setting that differs (learning_rate)")
    return parser.parse_args()


def main() -> None:
    """Make the copies, measure a report of each number of them, and print the figures."""
    given = options()
    rows: list[Mapping[str, Any]] = []
    with tempfile.TemporaryDirectory(dir=given.run.parent) as folder:
        copies, done = Path(folder, "copies"), 0
        for count in sorted(given.runs):
            for number in range(done, count):
                copy_run(given.run, copies / f"{number:05d}", given.setting, number)
            done = count
            found = measured(copies, Path(folder, f"report_{count}"), given.words)
            rows.append({"runs": count, **found})
            print(rows[-1], flush=True)
    print_table(rows)
    write_json(given.json, rows)


if __name__ == "__main__":
    main()
