"""A track guard that is chosen for an evaluation is fitted to carts that may differ from the nominal one."""

import pytest

from cartpole_rl.envs.build import with_fitted_guard
from cartpole_rl.workflows.build import evaluated_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig
from cartpole_rl.workflows.loading import load_settings


def fitted(**overrides: object) -> TrainConfig:
    return with_fitted_guard(load_settings(TrainConfig, {"guard": "careful", **overrides}))


@pytest.mark.parametrize("carts", ["wide", "half"])
def test_it_is_fitted_to_the_carts_of_the_training(carts: str) -> None:
    training = load_settings(TrainConfig, {"guard": "none", "randomization": carts})
    evaluation = load_settings(EvaluateConfig, {"run": "any", "guard": "careful"})
    settings = evaluated_settings(training, evaluation)
    assert settings.guard.active == fitted(randomization=carts).guard.active
    assert settings.randomization == {}


def test_it_is_fitted_to_the_carts_of_the_evaluation() -> None:
    training = load_settings(TrainConfig, {"guard": "none"})
    evaluation = load_settings(EvaluateConfig, {"run": "any", "guard": "careful", "randomization": "half"})
    assert evaluated_settings(training, evaluation).guard.active == fitted(randomization="half").guard.active


def test_the_guard_of_the_training_stays() -> None:
    training = fitted()
    settings = evaluated_settings(
        training, load_settings(EvaluateConfig, {"run": "any", "parameters": {"cart_mass": 0.8}})
    )
    assert settings.guard == training.guard
