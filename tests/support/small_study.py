"""A small study of real runs: the baseline without learning on two carts, three seeds, two evaluations."""

import contextlib
import io
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.workflows.config import EvaluateConfig
from cartpole_rl.workflows.evaluate import evaluate
from cartpole_rl.workflows.loading import load_settings

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
    "sizes": {"quick": {"seeds": 3, "evaluation_overrides": ["episodes=2"]}},
}
PARAMETERS = {"little": {"cart_viscous": 0.2}, "much": {"cart_viscous": 3.0}}
ONTO = {"nominal": {}, "heavy": {"cart_mass": 1.5}}


def run_baseline(folder: Path, seed: int, parameters: dict[str, float], episodes: int = 2) -> None:
    """Evaluate energy and LQR for STEPS periods from poles near upright."""
    given = {
        "run": "lqr",
        "episodes": episodes,
        "seed": seed,
        "parameters": parameters,
        "task": "swingup",
        "task.time_limit": STEPS,
        "task.evaluation_start.angle": "upright",
        "task.evaluation_start.angle_spread": 0.2,
        "task.evaluation_start.angular_speed_spread": 1.0,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        evaluate(load_settings(EvaluateConfig, given), folder)


def make_study(study: Path, size: str = "quick") -> None:
    """Make the folder of a study: its runs and its study.yaml."""
    for arm, parameters in PARAMETERS.items():
        for seed in (10, 11, 12):
            for name, more in ONTO.items():
                run_baseline(study / arm / str(seed) / "evaluations" / name, seed, {**parameters, **more})
    (study / "study.yaml").write_text(
        yaml.safe_dump({**STUDY, "size": size, "sizes": {size: STUDY["sizes"]["quick"]}})
    )
