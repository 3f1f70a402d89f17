"""The commands that the pages give, and how to run them within seconds."""

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

from command_line import ONCE, TINY, in_process

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = sorted([*ROOT.glob("docs/**/*.md"), ROOT / "runs/README.md", ROOT / "CONTRIBUTING.md"])
BUDGET = [*TINY, ONCE]  # of a training
TUNING = ["compile=false", "finetuning.iterations=1", "episodes=1", "evaluation_episodes=1"]
IDENTIFYING = ["windows=20", "substeps=1", "carts=100"]
NEED_EXTRAS = ("sweep=optuna", "learner=ray")  # which scripts/sweeps and scripts/bench/two_machines.py run
MODELLING = ["ensemble.updates=2", "ensemble.members=1", "windows=20"]


def block_lines(page: Path, start: str) -> list[str]:
    """Return the lines of indented blocks that match `start`, without comments; continued ones are joined."""
    text = re.sub(r" *\\\n +", " ", page.read_text(encoding="utf-8"))
    return re.findall(rf"^    ((?:{start}).*?)(?:\s+#.*)?$", text, re.M)


def guide_commands(start: str) -> Iterator[tuple[str, str]]:
    """Yield each command of the pages but the README that begins with `start`, and its page before it."""
    for page in PAGES:
        for line in block_lines(page, start):
            yield page.relative_to(ROOT).as_posix(), line


def within(budget: list[str], command: str) -> list[str]:
    """Return the settings of `budget` that `command` does not give itself."""
    return [word for word in budget if f" {word.split('=')[0]}=" not in command]


def run_here(command: str, *more: str, cwd: Path) -> "subprocess.CompletedProcess[str]":
    """Run a command line of the package in this process; it takes seconds to import PyTorch in another."""
    name, *words = shlex.split(command)
    verb = name.removeprefix("cartpole-").replace("-", "_")
    done = in_process(verb, *words, *more, folder=cwd)
    return subprocess.CompletedProcess(command, done.code, done.out, done.err)
