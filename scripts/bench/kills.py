#!/usr/bin/env python
"""Does a fine-tuning survive being killed? Kills one at random moments and resumes it each time.

    scripts/bench/kills.py runs/bench/medium/10 --kills 5 --seed 0

Starts `cartpole-finetune plant=emulated` with a small budget, sends it SIGKILL after a random time, and
resumes it; after the last kill it runs to its end. Further words are passed to cartpole-finetune as
overrides. Exit status 1 if

- an episode that was on disk at a kill has changed or is gone,
- the numbers of the episodes have a gap,
- the process that drove the cart, or the emulated cart, outlived the kill by 10 s, or
- the kept policy scores less than the policy before fine-tuning.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from common import mean_score

from cartpole_rl.evaluation.recordings import read_recording

SMALL = [
    "episodes=6",
    "evaluation_episodes=3",
    "finetuning.iterations=4",
    "finetuning.refit=2",
    "compile=false",
]
EARLIEST, LATEST = 8.0, 40.0  # s from the start to the kill; importing torch takes several
ORPHANS_END = 10.0  # s
STAGES = ("before", "tune", "after")


def start(words: list[str], log: Path) -> "subprocess.Popen[bytes]":
    """Start cartpole-finetune."""
    command = [str(Path(sys.executable).with_name("cartpole-finetune")), *words]
    with log.open("ab") as output:
        return subprocess.Popen(command, stdout=output, stderr=output)


def kill(process: "subprocess.Popen[bytes]") -> list[str]:
    """Send SIGKILL to the fine-tuning; return a complaint about each child that outlives it."""
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, ORPHANS_END)
    return [f"process {child.pid} outlived the kill" for child in alive]


def on_disk(run: Path) -> dict[str, bytes]:
    """Return the finished episodes by file name."""
    return {path.name: path.read_bytes() for path in sorted((run / "recordings").glob("*.csv"))}


def changed(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Return a complaint about each episode of `before` that differs or is missing in `after`."""
    return [f"{name} was changed or lost" for name, content in before.items() if after.get(name) != content]


def kill_and_resume(words: list[str], run: Path, kills: int, dice: random.Random) -> list[str]:
    """Kill and resume a fine-tuning, then let it run to its end; return all complaints."""
    log, complaints = run.parent / "log.txt", list[str]()
    kept: dict[str, bytes] = {}
    for number in range(kills):
        process, seconds = start(words, log), dice.uniform(EARLIEST, LATEST)
        try:
            process.wait(seconds)
            print(f"ended by itself within {seconds:.0f} s, exit status {process.returncode}")
            break
        except subprocess.TimeoutExpired:
            complaints += kill(process)
        now = on_disk(run)
        complaints += changed(kept, now)
        kept = now
        print(f"kill {number + 1} after {seconds:.1f} s: {len(now)} episodes on disk", flush=True)
        if (run / "checkpoints").exists():
            words = [f"resume={run}"]
    started = time.monotonic()
    status = start(words, log).wait()
    print(f"last start: {time.monotonic() - started:.0f} s to its end, exit status {status}")
    if status:
        sys.exit(log.read_text()[-2000:])
    return complaints + changed(kept, on_disk(run))


def check_result(run: Path) -> list[str]:
    """Print a summary of the finished run and return all complaints."""
    names, complaints = list(on_disk(run)), []
    counts = {stage: sum(name.startswith(stage) for name in names) for stage in STAGES}
    for stage, count in counts.items():
        numbered = [f"{stage}_{number:03d}.csv" for number in range(count)]
        if [name for name in names if name.startswith(stage)] != numbered:
            complaints.append(f"the numbers of the {stage} episodes have a gap: {names}")
    for name in names:
        read_recording(run / "recordings" / name)
    compared = json.loads((run / "comparison.json").read_text())
    means = {stage: compared[stage]["score"]["mean"] for stage in ("before", "after")}
    kept = mean_score(run / "metrics.json")
    if kept < means["before"]:
        complaints.append(f"the kept policy scores {kept:.0f}, less than {means['before']:.0f} before")
    print(f"{run}: {counts}, before {means['before']:.0f}, after {means['after']:.0f}, kept {kept:.0f}")
    return complaints


def main() -> int:
    """Kill, resume and check; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent", type=Path, help="run folder of cartpole-train")
    parser.add_argument("--kills", type=int, default=5, help="number of kills (5)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills (0)")
    options, overrides = parser.parse_known_args()
    run = Path(tempfile.mkdtemp(prefix="kills_"), "run")
    words = [f"run={options.agent}", "plant=emulated", *SMALL, *overrides, f"hydra.run.dir={run}"]
    complaints = kill_and_resume(words, run, options.kills, random.Random(options.seed))
    complaints += check_result(run)
    print("\n".join(complaints) or "no complaints")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
