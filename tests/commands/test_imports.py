"""Help, completion and complaints come before any work, and so before what takes seconds to import."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import cartpole_rl
from cartpole_rl.settings import Settings

COMMANDS = {  # command: words that name a run folder which is not there
    "emulate": None,
    "evaluate": "run=nowhere",
    "find_port": None,
    "finetune": "run=nowhere",
    "identify": "from=nowhere",
    "model": "from=nowhere",
    "preflight": None,
    "record": "run=nowhere",
    "replay": "from=nowhere",
    "train": "resume=nowhere",
}
WORK = {  # what only work needs
    "gymnasium",
    "matplotlib",
    "mujoco",
    "scipy",
    "tensorboard",
    "tensordict",
    "torch",
    "torchrl",
}
SHOW_MODULES = """
import json, sys
try:
    {0}
finally:
    print(json.dumps(sorted({{name.partition(".")[0] for name in sys.modules}})))
"""
RUN_COMMAND = "from cartpole_rl.commands.{0} import main; main()"


def modules_after(
    statement: str, *words: str, folder: Path, code: int = 0, **environment: str
) -> tuple[set[str], str]:
    """Top-level modules of a process after `statement` with `words` as arguments; what it said on stderr."""
    done = subprocess.run(
        [sys.executable, "-c", SHOW_MODULES.format(statement), *words],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == code, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1])), done.stderr


def command(name: str) -> str:
    """What the console script of a command does."""
    return RUN_COMMAND.format(name)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_here(name: str) -> None:
    assert (Path(cartpole_rl.__file__).parent / f"commands/{name}.py").is_file()


@pytest.mark.parametrize("words", [("--help",), ("--cfg", "job")], ids=" ".join)
@pytest.mark.parametrize("name", COMMANDS)
def test_what_it_shows_of_itself_needs_no_work(name: str, words: tuple[str, ...], tmp_path: Path) -> None:
    modules, told = modules_after(command(name), *words, folder=tmp_path)
    assert not modules & {*WORK, "numpy"}
    assert told == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_misspelt_key_is_told_without_work(name: str, tmp_path: Path) -> None:
    modules, told = modules_after(command(name), "seeed=1", folder=tmp_path, code=2)
    assert not modules & {*WORK, "numpy"}
    assert "seeed: there is no such setting" in told


@pytest.mark.parametrize("name", [name for name, words in COMMANDS.items() if words])
def test_a_missing_run_is_told_without_work(name: str, tmp_path: Path) -> None:
    words = COMMANDS[name]
    assert words is not None
    modules, told = modules_after(command(name), words, folder=tmp_path, code=1)
    assert not modules & {*WORK, "numpy"}
    assert f"{words}: there is no such" in told


def test_a_missing_port_is_told_without_pytorch(tmp_path: Path) -> None:
    modules, _ = modules_after(command("preflight"), "plant.port=nowhere", folder=tmp_path, code=1)
    assert not modules & WORK


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("train", "seed=abc", "valid integer"),
        ("train", "agent.gamma=1.5", "less than 1"),
        ("train", "agent.hidden=[7]", "even numbers of units"),
        ("train", "cart.cart_mass=-1", "cart_mass is -1"),
        ("train", "randomization.cart_mass.relative=[-1.5,0]", "it must be above 0"),
        ("train", "pole=tiny", "both, large, medium, range"),
        ("evaluate", "run=lqr parameters={latency:1}", "latency is 1"),
        ("evaluate", "run=lqr parameters={latencyy:1}", "did you mean 'latency'?"),
        ("finetune", "finetuning.epsilon=0.5", "less than or equal to 0.2"),
        ("identify", "pole=range", "choose it, as pole=medium"),
        ("emulate", "emulator.latency=2", "less than or equal to 1"),
        ("preflight", "home_timeout=0", "greater than 0"),
    ],
)
def test_a_wrong_value_is_told_without_work(name: str, words: str, said: str, tmp_path: Path) -> None:
    modules, told = modules_after(command(name), *words.split(), folder=tmp_path, code=2)
    assert not modules & {*WORK, "numpy"}
    assert said in told


def test_completion_needs_no_work(tmp_path: Path) -> None:
    line = {"COMP_LINE": "cartpole-train opt", "COMP_POINT": "18", "COMP_CWORD": "1"}
    modules, _ = modules_after(command("train"), "-sc", "query=bash", folder=tmp_path, **line)
    assert not modules & {*WORK, "numpy"}


def test_what_is_imported_for_the_work_is_quiet_too(tmp_path: Path) -> None:
    quiet = "import logging; from cartpole_rl.commands.application import quieten; quieten(); import torchrl"
    level = "assert logging.getLogger('torchrl').getEffectiveLevel() == logging.WARNING"
    modules, told = modules_after(f"{quiet}; {level}", folder=tmp_path)
    assert "torchrl" in modules
    assert told == ""


def settings_classes() -> Iterator[type[Settings]]:
    """Every settings class of the package."""
    for module in pkgutil.walk_packages(cartpole_rl.__path__, "cartpole_rl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    kinds = [Settings]
    while kinds:
        kind = kinds.pop()
        kinds.extend(kind.__subclasses__())
        yield kind


def test_a_settings_class_needs_no_work(tmp_path: Path) -> None:
    """All modules that define one are imported together."""
    names = {kind.__module__ for kind in settings_classes() if kind.__module__.startswith("cartpole_rl.")}
    assert len(names) > 10
    modules, _ = modules_after(f"import {', '.join(sorted(names))}", folder=tmp_path)
    assert not modules & WORK
