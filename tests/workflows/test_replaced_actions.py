"""An evaluation can give an agent other motor values, as many as it chooses from."""

import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.build import replaced_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig
from cartpole_rl.workflows.loading import load_settings


def test_motor_values_are_replaced() -> None:
    config = load_settings(EvaluateConfig, {"run": "somewhere", "actions": "nine_levels_linear"})
    settings = replaced_settings(load_settings(TrainConfig), config)
    assert settings.actions.motors == (-250, -188, -125, -63, 0, 63, 125, 188, 250)


def test_another_number_of_them_is_refused() -> None:
    config = load_settings(EvaluateConfig, {"run": "somewhere", "actions": "three"})
    with pytest.raises(ConfigError, match=r"^actions: 3 motor values, but the agent chooses from 9; give 9$"):
        replaced_settings(load_settings(TrainConfig), config)


def test_only_simulated_poles_are_knocked_by_an_evaluation() -> None:
    with pytest.raises(ConfigError, match=r"^knock: plant=emulated has its own cart"):
        load_settings(EvaluateConfig, {"run": "somewhere", "plant": "emulated", "knock": 8})
