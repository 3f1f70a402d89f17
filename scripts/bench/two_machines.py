#!/usr/bin/env python
"""What does a learner on another machine cost the cart, and what happens when the connection fails?

    scripts/bench/two_machines.py pretrained/medium local up slow brief cut killed --episodes 8

Runs `cartpole-finetune` on an emulated cart with the clock of a real one, on two network namespaces of this
computer: Ray's head with the learner on one, the cart on the other (`network.py`). Needs root on Linux, and
the extra `ray`. Both share the processors of this computer, so compare with `local` under the same load.

    local    one machine: the learner is a process beside the cart, no Ray
    up       two machines
    slow     each packet takes 50 ms, so a question and its answer take 100 ms
    brief    the cable is cut for 15 s after the second episode to learn from
    cut      the same for 90 s: Ray gives up the cart's node, which joins again
    killed   Ray is killed on the learner's machine, and started again once the cart waits
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from common import option_parser, positive_int, print_table, write_json
from network import Cable, Machine, two_machines
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cartpole_rl.learning.checkpoints import load_agent
from cartpole_rl.workflows.ray_learner import SETTINGS

PORT = 6479
DELAY = 0.05  # s, each way
CUT = {"brief": 15.0, "cut": 90.0}  # s
SCENARIOS = ("local", "up", "slow", *CUT, "killed")
CUT_AFTER = "tune_001.csv"
STALE = "is driven with weights from"  # in the output, once for each such episode
WAITING = "the cart waits for the learner"


@dataclass
class Row:
    """The result of one run."""

    scenario: str
    load: float  # mean number of busy processes of this computer
    minutes: float
    episodes: int
    stale: int  # episodes driven with earlier weights than on one machine
    updates: int
    ticks: int  # commands to the cart
    late: int  # ticks answered later than a period
    p999: float  # ms, of the largest of the driving processes


class Bench:
    """Two machines with a cable, and the folder of the runs."""

    def __init__(self, machines: tuple[Machine, Machine, Cable], options: argparse.Namespace) -> None:
        self.learner, self.cart, self.cable = machines
        self.options = options
        self.env = {**os.environ, **SETTINGS}
        self.processes: list[subprocess.Popen[bytes]] = []

    def close(self) -> None:
        """End what still runs."""
        for process in self.processes:
            process.terminate()
            process.wait()

    def run(self, scenario: str) -> Row:
        """Fine-tune in one scenario."""
        folder = self.options.folder / scenario
        self.cable.set(delay=DELAY if scenario == "slow" else 0.0)
        started, loads = time.monotonic(), [os.getloadavg()[0]]
        with self.ray_head() if scenario != "local" else nullcontext() as head:
            learner = [] if head is None else self.learner_words()
            process = self.finetune(folder, f"run={self.options.run}", *self.words(folder), *learner)
            if scenario in CUT:
                self.cut(folder, process, CUT[scenario])
            if head is not None and scenario == "killed":
                self.kill(folder, process, head)
            with self.ray_head() if scenario == "killed" else nullcontext():
                loads.append(os.getloadavg()[0])
                if process.wait() != 0:
                    sys.exit(f"{scenario}: see {folder}.log")
        loads.append(os.getloadavg()[0])
        return self.row(scenario, folder, sum(loads) / len(loads), (time.monotonic() - started) / 60)

    def learner_words(self) -> list[str]:
        """Return the overrides of a learner on the other machine."""
        address = f"learner.address={self.learner.address}:{PORT}"
        return ["learner=ray", address, f"learner.episodes_ahead={self.options.ahead}"]

    def words(self, folder: Path) -> list[str]:
        """Return the overrides of every run."""
        options = self.options
        return [
            "plant=emulated",
            "emulator.clock=real",
            f"episodes={options.episodes}",
            f"evaluation_episodes={options.evaluation_episodes}",
            f"finetuning.iterations={options.iterations}",
            f"hydra.run.dir={folder}",
            *options.overrides,
        ]

    def finetune(self, folder: Path, *words: str) -> "subprocess.Popen[bytes]":
        """Start cartpole-finetune on the cart's machine."""
        command = self.cart.command(sys.executable, "-m", "cartpole_rl.cli", "finetune", *words)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with folder.with_suffix(".log").open("ab") as log:
            process = subprocess.Popen(command, env=self.env, stdout=log, stderr=log)
        self.processes.append(process)
        return process

    @contextmanager
    def ray_head(self) -> Iterator["subprocess.Popen[bytes]"]:
        """Run Ray's head on the learner's machine."""
        words = ["start", "--head", "--block", f"--node-ip-address={self.learner.address}", f"--port={PORT}"]
        limits = ["--num-cpus=1", "--object-store-memory=200000000", "--include-dashboard=false"]
        ray = (sys.executable, "-m", "ray.scripts.scripts", *words, *limits, '--resources={"learner": 1}')
        with (
            tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as folder,
            (self.options.folder / "ray.log").open("wb") as log,
        ):
            command = self.learner.command(*ray, f"--temp-dir={folder}")
            head = subprocess.Popen(command, env=self.env, stdout=log, stderr=log)
            try:
                yield head
            finally:
                head.kill()  # its processes end with it
                head.wait()

    def cut(self, folder: Path, process: "subprocess.Popen[bytes]", seconds: float) -> None:
        """Cut the cable for `seconds` after CUT_AFTER."""
        self.wait_for(folder, process, lambda: (folder / "recordings" / CUT_AFTER).exists())
        self.note(folder, f"the cable is cut for {seconds:g} s")
        self.cable.set(cut=True)
        time.sleep(seconds)
        self.cable.set()
        self.note(folder, "the cable is restored")

    def kill(self, folder: Path, process: "subprocess.Popen[bytes]", head: "subprocess.Popen[bytes]") -> None:
        """Kill Ray on the learner's machine after CUT_AFTER; return once the cart waits."""
        self.wait_for(folder, process, lambda: (folder / "recordings" / CUT_AFTER).exists())
        self.note(folder, "Ray is killed on the learner's machine")
        head.kill()
        self.wait_for(folder, process, lambda: WAITING in folder.with_suffix(".log").read_text())
        self.note(folder, "Ray is started again")

    def wait_for(self, folder: Path, process: "subprocess.Popen[bytes]", condition: object) -> None:
        """Wait until `condition()` is true. Raises SystemExit if the run ends before."""
        assert callable(condition)
        while not condition():
            if process.poll() is not None:
                sys.exit(f"the run ended too early: see {folder}.log")
            time.sleep(0.2)

    def note(self, folder: Path, text: str) -> None:
        """Write a line into the run's output."""
        with folder.with_suffix(".log").open("a") as log:
            log.write(f"--- {time.strftime('%H:%M:%S')} {text}\n")

    def row(self, scenario: str, folder: Path, load: float, minutes: float) -> Row:
        """Return the figures of a run."""
        curves = read_curves(folder)
        before = int(load_agent(self.options.run).weights["updates"])
        return Row(
            scenario,
            load,
            minutes,
            len(list((folder / "recordings").glob("tune_*.csv"))),
            folder.with_suffix(".log").read_text().count(STALE),
            int(max(curves["learning/updates"])) - before,
            total(curves["link/latency_samples"]),
            total(curves["link/late_ticks"]),
            max(curves["link/latency_p999_ms"]),
        )


def read_curves(run: Path) -> dict[str, list[float]]:
    """Return the points of each TensorBoard curve of a run, in the order of writing."""
    curves: dict[str, list[float]] = defaultdict(list)
    for file in sorted(run.glob("events*")):
        for event in EventFileLoader(str(file)).Load():
            for value in event.summary.value:
                curves[value.tag].append(value.tensor.float_val[0] if value.tensor.float_val else 0.0)
    return curves


def total(counts: list[float]) -> int:
    """Return the sum of a running count that starts again at 0 with each driving process."""
    ends = [count for count, after in zip(counts, [*counts[1:], -1], strict=True) if after < count]
    return round(sum(ends))


def main() -> None:
    """Run the scenarios that are named on the command line, and print the table."""
    parser = option_parser(__doc__)
    parser.add_argument("run", type=Path, help="the agent to fine-tune")
    parser.add_argument(
        "scenarios", nargs="+", choices=SCENARIOS, metavar="SCENARIO", help=", ".join(SCENARIOS)
    )
    parser.add_argument("--episodes", type=positive_int, default=8, help="to learn from (8)")
    parser.add_argument("--evaluation-episodes", type=positive_int, default=2, help="before and after (2)")
    parser.add_argument("--iterations", type=positive_int, default=60, help="of learning per episode (60)")
    parser.add_argument("--ahead", type=int, default=2, help="episodes with earlier weights (2)")
    parser.add_argument("--folder", type=Path, default=Path("runs/bench/two_machines"), help="of the runs")
    parser.add_argument("--overrides", nargs="*", default=[], help="more, for cartpole-finetune")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # remove the machines in this case too
    options.folder = options.folder.absolute()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    with two_machines("cartpole") as machines, closing(Bench(machines, options)) as bench:
        for scenario in options.scenarios:
            rows.append(bench.run(scenario))
            write_json(options.json, [vars(row) for row in rows])
    print_table([vars(row) for row in rows])


if __name__ == "__main__":
    main()
