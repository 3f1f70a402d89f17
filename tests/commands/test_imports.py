"""Help, completion and complaints come before any work, and so before what takes seconds to import."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cartpole_rl
from cartpole_rl.cli import VERBS
from cartpole_rl.settings import Settings

SHOWS = (("--help", 0, ""), ("--cfg job", 0, ""), ("seeed=1", 2, "seeed: there is no such setting"))
COMPLETION = {"COMP_LINE": "cartpole-train opt", "COMP_POINT": "18", "COMP_CWORD": "1"}  # as of a shell
COMPLAINS = {  # command: words, exit code, part of the line on stderr
    "emulate": [("emulator.latency=2", 2, "give at most 1")],
    "evaluate": [
        ("run=nowhere", 1, "run=nowhere: there is no such file or folder"),
        ("run=lqr repeat.run=nowhere seed=1", 2, "leave out seed=1"),
        ("run=lqr parameters={latency:1}", 2, "latency is 1"),
        ("run=lqr parameters={latencyy:1}", 2, "did you mean 'latency'?"),
        ("run=lqr plant=learned plant.model=nowhere", 1, "plant.model=nowhere: there is no such file"),
    ],
    "export": [
        ("run=nowhere format=c", 1, "run=nowhere: there is no such file or folder"),
        ("run=pretrained/small format=c", 1, "there are pretrained/"),
        ("run=pretrained/medium", 2, "give format=weights, onnx, c, web, firmware, minari or mcap"),
        (
            "run=pretrained/medium format=java",
            2,
            "'weights', 'onnx', 'c', 'web', 'firmware', 'minari' or 'mcap'",
        ),
        ("format=c", 2, "give run=<run folder"),
        ("format=mcap", 2, "format=mcap needs from=<run folder of cartpole-record>"),
        ("format=mcap from=nowhere", 2, "from=nowhere: there is no such file or folder"),
        ("format=minari from=nowhere run=lqr", 2, "leave out run, cart and pole"),
        ("format=c from=nowhere run=lqr", 2, "from: format=minari or format=mcap exports recordings"),
        ("format=firmware run=pretrained/medium", 2, "run: format=firmware writes the numbers of a cart"),
        ("run=pretrained/medium format=c cart=ip02", 2, "format=c exports an agent with its own cart"),
        ("run=pretrained/medium format=c pole=large", 2, "format=c exports an agent with its own pole"),
        ("format=firmware cart=stepper", 2, "our firmware drives a DC motor, not a stepper"),
    ],
    "distill": [
        ("run=nowhere", 1, "run=nowhere: there is no such file or folder"),
        ("run=pretrained/medium distillation.rounds=0", 2, "give at least 1"),
    ],
    "find_port": [("timeout=0", 2, "give more than 0")],
    "finetune": [
        ("run=nowhere", 1, "run=nowhere: there is no such file or folder"),
        ("resume=nowhere", 1, "resume=nowhere: there is no such folder"),
        ("finetuning.epsilon=0.5", 2, "give at most 0.2"),
        ("learner=ray", 2, "learner.address is missing; give learner.address=<host>:6379"),
    ],
    "identify": [
        ("from=nowhere", 2, "from=nowhere: there is no such file or folder"),
        ("pole=range", 2, "choose one, as pole=medium"),
    ],
    "model": [
        ("from=nowhere", 2, "from=nowhere: there is no such file or folder"),
        ("from=nowhere windows=1", 2, "give at least 10"),
    ],
    "preflight": [("plant.port=nowhere plant.home_timeout=0", 2, "give more than 0")],
    "record": [("run=nowhere", 1, "run=nowhere: there is no such file or folder")],
    "report": [
        ("runs=[]", 2, "give runs=<run folders or patterns>"),
        ("seed=1", 2, "seed: there is no such setting"),
        ("animations=maybe runs=nowhere", 2, "give true or false"),
    ],
    "import": [("from=nowhere", 2, "from=nowhere: there is no such file or folder")],
    "replay": [("from=nowhere", 2, "from=nowhere: there is no such file or folder")],
    "train": [
        ("resume=nowhere", 1, "resume=nowhere: there is no such folder"),
        ("agent.hidden=[7]", 2, "even numbers of units"),
        ("cart.cart_mass=-1", 2, "cart_mass is -1"),
        ("randomization.cart_mass.relative=[-1.5,0]", 2, "it must be above 0"),
        ("pole=tiny", 2, "both, laboratorio, large, medium, range"),
    ],
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
SUPPORT = str(Path(__file__).parents[1] / "support")
RUN_IN_TURN = """
import contextlib, gc, io, json, sys
gc.disable()
sys.path.append({support!r})
import files_read_once
from hydra.core.global_hydra import GlobalHydra
from cartpole_rl.cli import run

runs = []
for command, words in {commands}:
    GlobalHydra.instance().clear()
    sys.argv[1:] = words.split()
    code, said = 0, io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        try:
            run(command)
        except SystemExit as ended:
            code = ended.code
    runs.append((code, said.getvalue(), sorted({{name.partition(".")[0] for name in sys.modules}})))
print(json.dumps(runs))
"""
IMPORT = """
import json, sys
{statement}
print(json.dumps(sorted({{name.partition(".")[0] for name in sys.modules}})))
"""


def last_line(script: str, folder: Path, **environment: str) -> Any:
    """The last line, which is JSON, that a script prints in a separate process."""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_help_completion_and_errors_need_no_slow_imports(tmp_path: Path) -> None:
    """All commands in one process: the first one that imports what is slow is named."""
    assert VERBS.keys() == COMPLAINS.keys()
    cases = [("train", "-sc query=bash", 0, "")]
    for command, complaints in COMPLAINS.items():
        shows = SHOWS if command in ("train", "preflight") else SHOWS[:1]
        cases += [(command, *case) for case in (*shows, *complaints)]
    cases.append(("preflight", "plant.port=nowhere", 1, ""))
    script = RUN_IN_TURN.format(commands=[case[:2] for case in cases], support=SUPPORT)
    runs = last_line(script, tmp_path, **COMPLETION)
    for (command, words, expected, part), (code, said, modules) in zip(cases, runs, strict=True):
        slow = WORK if words == "plant.port=nowhere" else {*WORK, "numpy"}
        assert (code, slow & {*modules}) == (expected, set()), (command, words)
        assert part in said, (command, words)


def test_slow_imports_print_nothing(tmp_path: Path) -> None:
    quiet = "from cartpole_rl.command import quieten; quieten(); import logging, torchrl"
    level = "assert logging.getLogger('torchrl').getEffectiveLevel() == logging.WARNING"
    assert "torchrl" in last_line(IMPORT.format(statement=f"{quiet}; {level}"), tmp_path)


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
    imported = last_line(IMPORT.format(statement=f"import {', '.join(sorted(names))}"), tmp_path)
    assert WORK & {*imported} == set()
