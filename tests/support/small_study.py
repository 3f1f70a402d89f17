"""A small study: the baseline without learning on two carts, three seeds, two evaluations.

One of its runs is real; the others are copies with other settings and scores.
"""

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.workflows.config import EvaluateConfig, load_settings
from cartpole_rl.workflows.evaluate import evaluate

STEPS = 40  # control periods of an episode
STUDY: dict[str, Any] = {
    "title": "Energy and LQR <with> friction",
    "order": 180,
    "figure": "6.8",
    "question": "Does friction matter?",
    "thesis": "It was not asked.",
    "measure": "score_upright",
    "ratio": True,
    "arms": [
        {"name": "little", "label": "little friction", "overrides": ["parameters={cart_viscous:0.2}"]},
        {"name": "much", "label": "much friction", "overrides": ["parameters={cart_viscous:3}"]},
    ],
    "evaluations": [
        {"name": "nominal", "label": "nominal cart"},
        {"name": "heavy", "label": "heavy cart", "overrides": ["parameters={cart_mass:1.5}"]},
    ],
    "command": "evaluate",
    "size": "quick",
    "sizes": {"quick": {"seeds": 3, "evaluation_overrides": ["episodes=2"]}},
}
PARAMETERS = {"little": {"cart_viscous": 0.2}, "much": {"cart_viscous": 3.0}}
ONTO = {"nominal": {}, "heavy": {"cart_mass": 1.5}}


def run_baseline(folder: Path, seed: int, parameters: dict[str, float]) -> None:
    """Evaluate energy and LQR for STEPS periods from poles near upright."""
    given = {
        "run": "lqr",
        "episodes": 2,
        "seed": seed,
        "parameters": parameters,
        "task": "swingup",
        "task.time_limit": STEPS,
        "task.evaluation_start.angle": "upright",
        "task.evaluation_start.angle_spread": 0.2,
        "task.evaluation_start.angular_speed_spread": 1.0,
    }
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        evaluate(load_settings(EvaluateConfig, given), folder)


def make_study(study: Path) -> None:
    """Make the folder of a study: its runs and its study.yaml."""
    first = study / "little/10/evaluations/nominal"
    run_baseline(first, 10, PARAMETERS["little"])
    for number, (arm, parameters) in enumerate(PARAMETERS.items()):
        for seed in (10, 11, 12):
            for name, more in ONTO.items():
                place = study / arm / str(seed) / "evaluations" / name
                if place != first:
                    copy_run(first, place, seed, {**parameters, **more}, 1 - 0.01 * (seed + 10 * number))
    (study / "study.yaml").write_text(yaml.safe_dump(STUDY))


def copy_run(run: Path, place: Path, seed: int, parameters: dict[str, float], factor: float) -> None:
    """Copy an evaluation as that of another seed and cart, with its scores times `factor`."""
    shutil.copytree(run, place)
    config = yaml.safe_load((run / "config.yaml").read_text())
    changed = {**config, "seed": seed, "parameters": parameters}
    (place / "config.yaml").write_text(yaml.safe_dump(changed, sort_keys=False))
    metrics = json.loads((run / "metrics.json").read_text())
    for name in ("score", "score_upright"):
        metrics[name]["mean"] *= factor
    (place / "metrics.json").write_text(json.dumps(metrics))


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all studies, with one in it; it is not to be changed."""
    root = tmp_path_factory.mktemp("studies") / "quick"
    make_study(root / "friction")
    return root


@pytest.fixture
def study(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the study, to damage; the working directory is above the folder of all studies."""
    shutil.copytree(made, tmp_path / "quick")
    monkeypatch.chdir(tmp_path)
    return Path("quick/friction")


@pytest.fixture
def edit() -> Callable[[Path, Callable[[Any], object]], None]:
    """Change a JSON or YAML file in place."""

    def change(path: Path, how: Callable[[Any], object]) -> None:
        is_json = path.suffix == ".json"
        content = (json.loads if is_json else yaml.safe_load)(path.read_text())
        how(content)
        path.write_text((json.dumps if is_json else yaml.safe_dump)(content))

    return change
