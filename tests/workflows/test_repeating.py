"""The settings of a repeated episode."""

from pathlib import Path

import pytest

from cartpole_rl.choices import choice
from cartpole_rl.tasks.episode import Origin
from cartpole_rl.workflows.config import EvaluateConfig, load_settings
from cartpole_rl.workflows.episodes import same_evaluation

GUARD = {**choice("guard/fitted"), "numbers": {"margin": 0.05, "delay": 0.2, "deceleration": 2.0}}
POLE = {"pole_mass": 0.127, "pole_com": 0.1778, "pole_inertia": 0.001199}


@pytest.mark.parametrize(
    ("run", "same"),
    [("runs/a", True), (f"{Path.cwd()}/runs/a", True), ("runs/../runs/a", True), ("runs/b", False)],
)
def test_the_same_agent_has_the_guard_of_then_however_its_folder_is_spelt(run: str, same: bool) -> None:
    former = load_settings(EvaluateConfig, {"run": "runs/a", "pole": "both"})
    recorded = {**former.model_dump(mode="json"), "evaluated": {"guard": GUARD}}
    config = load_settings(EvaluateConfig, {"run": run})
    repeated = same_evaluation(config, recorded, Origin({**POLE, "cart_mass": 0.7}, {}))
    assert repeated.run == Path(run)
    assert (repeated.guard is not None) == same
