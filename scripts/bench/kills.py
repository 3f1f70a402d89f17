#!/usr/bin/env python
"""A fine-tuning that is killed at random moments, and resumed each time.

    scripts/bench/kills.py runs/bench/medium/0 [--kills 5] [--seed 0] [overrides ...]

Starts `cartpole-finetune plant=emulated` with a small budget, or what the overrides say, sends it SIGKILL
after a random time, and resumes it; after the last kill it is left to its end. Exit status 1 if an episode
that was on disk when it was killed has changed or is gone, if a number is missing or there twice, if the
process that drove the cart or the emulated cart outlived it, or if the kept policy scores less than the one
before.
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

from cartpole_rl.evaluation.recordings import read_recording

SMALL = [
    "episodes=6",
    "evaluation_episodes=3",
    "finetuning.iterations=4",
    "finetuning.refit=2",
    "compile=false",
]
SOONEST, LATEST = 8.0, 40.0  # s after the start; loading torch takes several
ORPHANS_END = 10.0  # s


def start(words: list[str], log: Path) -> "subprocess.Popen[bytes]":
    """cartpole-finetune, just started."""
    command = [Path(sys.executable).with_name("cartpole-finetune"), *words]
    with log.open("ab") as output:
        return subprocess.Popen(command, stdout=output, stderr=output)


def kill(process: "subprocess.Popen[bytes]") -> list[str]:
    """SIGKILL to the process that learns; what of its children is still there a while later."""
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, ORPHANS_END)
    return [f"{child.pid} outlived the kill" for child in alive]


def on_disk(run: Path) -> dict[str, bytes]:
    """The finished episodes, by file name."""
    return {path.name: path.read_bytes() for path in sorted((run / "recordings").glob("*.csv"))}


def changed(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Episodes that were there and are not any more, or not as they were."""
    return [f"{name} was changed or lost" for name, content in before.items() if after.get(name) != content]


def main() -> int:
    """Kill, resume, look; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agent", type=Path, help="run folder of a training")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    options, overrides = parser.parse_known_args()
    dice, wrong = random.Random(options.seed), []
    run = Path(tempfile.mkdtemp(prefix="kills_"), "run")
    words = [f"run={options.agent}", "plant=emulated", *SMALL, *overrides, f"hydra.run.dir={run}"]
    kept: dict[str, bytes] = {}
    for number in range(options.kills):
        process, seconds = start(words, run.parent / "log.txt"), dice.uniform(SOONEST, LATEST)
        try:
            process.wait(seconds)
            print(f"ended by itself after less than {seconds:.0f} s, code {process.returncode}")
            break
        except subprocess.TimeoutExpired:
            wrong += kill(process)
        now = on_disk(run)
        wrong += changed(kept, now)
        kept = now
        print(f"kill {number + 1} after {seconds:.1f} s: {len(now)} episodes on disk", flush=True)
        if (run / "checkpoints").exists():
            words = [f"resume={run}"]
    begun = time.monotonic()
    code = start(words, run.parent / "log.txt").wait()
    print(f"left to its end: {time.monotonic() - begun:.0f} s, code {code}")
    if code:
        print((run.parent / "log.txt").read_text()[-2000:])
        return 1
    now = on_disk(run)
    compared = json.loads((run / "comparison.json").read_text())
    means = {stage: compared[stage]["score"]["mean"] for stage in ("before", "after")}
    counts = {stage: sum(name.startswith(stage) for name in now) for stage in ("before", "tune", "after")}
    wrong += changed(kept, now)
    for stage, count in counts.items():
        if [name for name in now if name.startswith(stage)] != [f"{stage}_{n:03d}.csv" for n in range(count)]:
            wrong.append(f"the numbers of {stage} have gaps: {sorted(now)}")
    for name in now:
        read_recording(run / "recordings" / name)
    score = json.loads((run / "metrics.json").read_text())["score"]["mean"]
    if score < means["before"]:
        wrong.append(f"the kept policy scores {score:.0f}, less than before")
    print(f"{run}: {counts}, before {means['before']:.0f}, after {means['after']:.0f}, kept {score:.0f}")
    print("\n".join(wrong) or "nothing wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
