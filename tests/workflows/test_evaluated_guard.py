"""The track guard of an evaluation: chosen, of the training, or fitted anew to motor values or a pole."""

from pathlib import Path

import numpy as np
import pytest

from cartpole_rl.envs.build import with_fitted_guard
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.workflows.build import evaluated_settings, guard_note
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings

GIVEN = {"margin": 0.05, "delay": 0.2, "deceleration": 2.0}
SAME_ENDS = (-250, -188, -125, -63, 0, 63, 125, 188, 250)


def fitted(**overrides: object) -> TrainConfig:
    return with_fitted_guard(load_settings(TrainConfig, {"guard": "careful", **overrides}))


def evaluated(training: TrainConfig, **overrides: object) -> tuple[CartPoleSettings, str | None]:
    """The settings of an evaluation, and the note about its guard."""
    evaluation = load_settings(EvaluateConfig, {"run": "any", **overrides})
    settings = evaluated_settings(training, evaluation)
    return settings, guard_note(training, evaluation, settings)


@pytest.mark.parametrize("of_training", [True, False])
def test_a_chosen_one_is_fitted_to_the_carts_of_the_training_or_of_the_evaluation(of_training: bool) -> None:
    carts = {"randomization": "half"}
    training = load_settings(TrainConfig, {"guard": "none", **(carts if of_training else {})})
    settings, _ = evaluated(training, guard="careful", **({} if of_training else carts))
    assert settings.guard.active == fitted(**carts).guard.active
    assert (settings.randomization == {}) == of_training


WEAK = (-150, -130, -110, -90, 0, 90, 110, 130, 150)
SERIAL = {"plant": "serial", "plant.port": "port"}


def with_motors(motors: tuple[int, ...]) -> dict[str, object]:
    return {"actions": {"motors": motors, "actuator": "force_curve"}}


@pytest.mark.parametrize(
    "given",
    [
        {"parameters": {"cart_mass": 0.8}, "randomization": "half"},
        with_motors(SAME_ENDS),
        {**SERIAL, "plant.policy": "onboard", "plant.pole_length": 0.66},  # compiled with it
    ],
    ids=["other carts", "motor values with the same ends", "policy on a board"],
)
def test_the_guard_of_the_training_stays(given: dict[str, object]) -> None:
    training = fitted()
    settings, note = evaluated(training, **given)
    assert (settings.guard, note) == (training.guard, None)


@pytest.mark.parametrize("cart", [SERIAL, {"parameters": {"cart_mass": 0.9}, "randomization": "half"}])
def test_it_is_fitted_anew_to_other_full_motor_values(cart: dict[str, object]) -> None:
    """A simulated cart does not tell it its parameters: it is that of the carts of the training."""
    training = fitted()
    settings, note = evaluated(training, **cart, **with_motors(WEAK))
    numbers = fitted(**with_motors(WEAK)).guard.active
    assert numbers.deceleration < 0.8 * training.guard.active.deceleration
    assert settings.guard.active == numbers
    assert note == (
        f"note: the track guard of the training is for other full motor values; fitted anew: {numbers}"
    )


@pytest.mark.parametrize(
    ("trained", "cart", "fitted_to"),
    [
        ("medium", {"plant": "emulated"}, "medium"),
        ("both", {"pole": "medium"}, "both"),
        ("medium", {"pole": "large"}, "large"),
        ("medium", {**SERIAL, "plant.pole_length": 0.66}, "large"),
    ],
)
def test_it_is_fitted_anew_to_a_pole_that_was_not_in_training(
    trained: str, cart: dict[str, object], fitted_to: str
) -> None:
    settings, note = evaluated(fitted(pole=trained), **cart)
    numbers = fitted(pole=fitted_to).guard.active
    assert settings.guard.active == numbers
    line = "note: the track guard of the training is for another pole; fitted anew to 0.66 m, 0.23 kg: "
    assert note == (None if fitted_to == trained else f"{line}{numbers}")


def test_identified_carts_carry_the_other_pole_when_it_is_fitted_anew(tmp_path: Path) -> None:
    """The identified pole has no part in the guard for another one."""
    training = load_settings(TrainConfig, {"guard": "careful"})
    names = list(CartParameters.names())
    nominal = training.nominal_with(training.pole.nominal)
    carts = np.repeat([[nominal[name]] for name in names], 2, axis=1)
    np.savez(tmp_path / "posterior.npz", names=names, carts=carts, identified=names)
    of_one_cart = {"posterior": tmp_path / "posterior.npz", "widen": 1.0, "prior_share": 0.0, "ranges": {}}
    training = fitted(randomization=of_one_cart)
    numbers = evaluated(training, **SERIAL, **{"plant.pole_length": 0.66})[0].guard.active
    assert numbers == fitted(randomization=of_one_cart, pole="large").guard.active
    assert numbers.pole.length == pytest.approx(0.6604)


@pytest.mark.parametrize(
    ("trained", "mass", "is_refitted"),
    [("medium", 0.14, False), ("medium", 0.2, True), ("range", 0.2, False)],
)
def test_it_is_fitted_anew_to_a_heavier_pole_of_the_same_length(
    trained: str, mass: float, is_refitted: bool
) -> None:
    """Rods of 0.36 m have 0.25 kg in training."""
    pole = {"choices": {"mine": {"pole_mass": mass, "pole_com": 0.1778, "pole_inertia": 2e-3}}}
    training = fitted(pole=trained, randomization="half", guard="fitted")
    settings, note = evaluated(training, **SERIAL, pole=pole)
    assert (settings.guard != training.guard) == bool(note) == is_refitted


@pytest.mark.parametrize("chosen", [{"guard": "none"}, {"guard.numbers": GIVEN, "guard": "careful"}])
def test_a_chosen_guard_is_not_replaced(chosen: dict[str, object]) -> None:
    settings, note = evaluated(fitted(), **chosen, **with_motors(WEAK))
    assert settings.guard == load_settings(EvaluateConfig, {"run": "any", **chosen}).guard
    assert note is None
