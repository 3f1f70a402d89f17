#!/usr/bin/env python
"""The longest silence of each command, as a person at a terminal sees it.

    scripts/bench/silence.py [--only evaluate finetune] [--limit 120] [--json silence.json]

Each command runs on a pseudo-terminal in a new folder, with settings of a short run; the emulated cart keeps
real time. A silence is the time without any output: from the start to the first character, between two
outputs, and to the end. The table names what stood on the last line when the longest one began. A command
that takes longer than the limit is interrupted. Times are this computer's, start of Python included.
"""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import tempfile
import termios
import time
from dataclasses import dataclass
from pathlib import Path

from common import option_parser, positive_int, print_table, write_json

SHORT = ("learning.transitions=200000", "learning.evaluations=2")
REAL = ("plant=emulated", "emulator.clock=real")
TUNING = ("episodes=2", "evaluation_episodes=1", "finetuning.iterations=20")
COMMANDS = {  # in this order: some read the runs of earlier ones
    "train": ("experiment=medium", *SHORT, "hydra.run.dir=runs/train/first"),
    "evaluate": ("run=pretrained/medium", "episodes=20"),
    "evaluate on a cart": ("run=pretrained/medium", *REAL, "episodes=2"),
    "record": ("run=lqr", *REAL, "episodes=1", "hydra.run.dir=runs/record/first"),
    "replay": ("from=runs/record/first",),
    "preflight": REAL,
    "identify": (*REAL, "pole=medium", "hydra.run.dir=runs/identify/first"),
    "model": ("from=runs/identify/first",),
    "finetune": ("run=pretrained/medium", *REAL, *TUNING),
    "distill": ("run=pretrained/medium", "hidden=[32,32]", "distillation.rounds=3"),
    "export": ("run=pretrained/medium", "format=onnx"),
    "report": ("runs=runs/train/first",),
    "gymnasium.make": (),
}
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


@dataclass
class Silence:
    """The longest time without output, s, and the last line before it."""

    seconds: float = 0.0
    after: str = "start"


def words_of(name: str, settings: tuple[str, ...]) -> list[str]:
    """Return the words of a command line."""
    if name == "gymnasium.make":
        program = "import gymnasium, cartpole_rl; gymnasium.make('cartpole_rl/SwingUp-v0').reset(seed=0)"
        return [sys.executable, "-c", program]
    verb = name.split()[0]
    return [sys.executable, "-c", f"from cartpole_rl.cli import {verb}; {verb}()", *settings]


def measured(words: list[str], folder: Path, limit: float) -> dict[str, object]:
    """Return the duration of a command, s, its longest silence and how it ended."""
    reader, terminal = pty.openpty()
    termios.tcsetwinsize(terminal, (30, 100))
    started = last = time.monotonic()
    longest, line, interrupted = Silence(), "start", False
    process = subprocess.Popen(words, cwd=folder, stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    while True:
        ready, _, _ = select.select([reader], [], [], 0.1)
        now = time.monotonic()
        if now - last > longest.seconds:
            longest = Silence(now - last, line)
        if now - started > limit and not interrupted:
            process.send_signal(signal.SIGINT)
            interrupted = True
        if not ready:
            continue
        try:
            text = os.read(reader, 65536).decode(errors="replace")
        except OSError:  # the terminal is closed
            break
        last = now
        lines = [part.strip() for part in re.split(r"[\r\n]+", ESCAPES.sub("", text)) if part.strip()]
        line = lines[-1] if lines else line
    code = process.wait()
    os.close(reader)
    return {
        "s": round(time.monotonic() - started, 1),
        "longest silence, s": round(longest.seconds, 1),
        "after": longest.after[:70],
        "end": "interrupted" if interrupted else code,
    }


def main() -> None:
    """Measure the commands, print the table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=[*COMMANDS], metavar="COMMAND")
    parser.add_argument("--limit", type=positive_int, default=120, help="s, after which it is interrupted")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in options.only:
            figures = measured(words_of(name, COMMANDS[name]), Path(folder), options.limit)
            rows.append({"command": name, **figures})
            print(rows[-1], flush=True)
    print_table(rows)
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
