"""Action sets: which motor values may be chosen among."""

import pytest
from pydantic import ValidationError

from cartpole_rl.tasks.settings import ActionSettings


def test_motor_values_by_index() -> None:
    assert ActionSettings(motors=[-200, 0, 200], actuator="newtons").motors == (-200, 0, 200)


@pytest.mark.parametrize("motors", [[], [100], [100, 100], [0, 256], [-256, 0]])
def test_impossible_sets_are_refused(motors: list[int]) -> None:
    with pytest.raises(ValidationError):
        ActionSettings(motors=motors, actuator="newtons")


def test_an_unknown_actuator_is_refused() -> None:
    with pytest.raises(ValidationError):
        ActionSettings(motors=[-1, 1], actuator="rocket")
