"""The task's settings: the score that judges an agent."""

import pytest

from cartpole_rl.choices import choice
from cartpole_rl.tasks.settings import TaskSettings


@pytest.mark.parametrize(("task", "measure"), [("balance", "score_upright"), ("swingup", "score")])
def test_a_balance_is_judged_by_6_1_and_a_swing_up_by_6_2(task: str, measure: str) -> None:
    assert TaskSettings(**{**choice(f"task/{task}"), "x_max": 0.38}).measure == measure
