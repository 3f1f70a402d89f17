"""The settings of an evaluation: those that replace the training's, and those of a repeated episode."""

from pathlib import Path

import pytest

from cartpole_rl.agents.baseline import regulator
from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import cart_column
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.tasks.episode import Origin
from cartpole_rl.tasks.settings import ActionSettings
from cartpole_rl.workflows.build import evaluated_agent, evaluated_settings, replaced_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings
from cartpole_rl.workflows.episodes import same_evaluation


@pytest.mark.parametrize(
    ("motors", "complaint"),
    [
        ([-250, 0, 250], r"^actions: 3 motor values, but the agent chooses from 9; give 9$"),
        ([250, 200, 150, 100, 0, -100, -150, -200, -250], "would push in other directions than in its"),
        ([-250, -200, -150, 0, -100, 100, 150, 200, 250], "would push in other directions than in its"),
        ([-250, -200, -150, -100, 10, 100, 150, 200, 250], "would push in other directions than in its"),
    ],
)
def test_motor_values_of_another_meaning_are_refused(motors: list[int], complaint: str) -> None:
    config = load_settings(EvaluateConfig, {"run": "somewhere"})
    config = config.model_copy(update={"actions": ActionSettings(motors=motors, actuator="force_curve")})
    with pytest.raises(ConfigError, match=complaint):
        replaced_settings(load_settings(TrainConfig), config)


@pytest.mark.parametrize(
    ("length", "name"), [(0.36, "medium"), (0.66, "large"), (0.5, "0.50 m"), (None, None)]
)
def test_a_serial_cart_has_the_pole_of_the_stated_length(length: float | None, name: str | None) -> None:
    plant = {"plant": "serial", "plant.port": "port", "plant.pole_length": length}
    training = load_settings(TrainConfig, {"experiment": "both"})
    settings = replaced_settings(training, load_settings(EvaluateConfig, {"run": "somewhere", **plant}))
    assert settings.pole.name == (name or training.pole.name)


def test_only_simulated_poles_are_knocked_by_an_evaluation() -> None:
    with pytest.raises(ConfigError, match=r"^knock: plant=emulated has its own cart"):
        load_settings(EvaluateConfig, {"run": "somewhere", "plant": "emulated", "knock": 8})


def test_motor_values_are_replaced() -> None:
    config = load_settings(EvaluateConfig, {"run": "somewhere", "actions": "nine_levels_linear"})
    settings = replaced_settings(load_settings(TrainConfig), config)
    assert settings.actions.motors == (-250, -188, -125, -63, 0, 63, 125, 188, 250)


def test_an_agent_of_another_rig_is_refused() -> None:
    training = load_settings(TrainConfig, {"cart.track_span": 0.78})
    config = load_settings(EvaluateConfig, {"run": "somewhere", "cart": "ip02"})
    with pytest.raises(ConfigError, match=r"0\.814 m of track, but .* 0\.78 m of track; train one"):
        replaced_settings(training, config)
    baseline = config.model_copy(update={"run": Path("lqr")})
    assert replaced_settings(training, baseline).hardware.track_span == 0.814


def test_the_baseline_is_computed_for_the_cart_and_the_period_that_it_drives() -> None:
    stepper = {"cart": "stepper", "plant": "emulated", "emulator": "rod_03", "control_period": 0.01}
    of_ip02 = evaluated_agent(load_settings(EvaluateConfig, {"run": "lqr", "pole": "rod_03"}))
    config = load_settings(EvaluateConfig, {"run": "lqr", **stepper})
    agent = evaluated_agent(config)
    settings = evaluated_settings(agent.training, config)
    assert (settings.control_period, settings.hardware) == (0.01, hardware_of(config.cart or {}))
    assert agent.policy.cart.cart_mass == settings.cart["cart_mass"]  # type: ignore[attr-defined]
    gain = regulator(cart_column(settings.nominal_with(settings.pole.nominal)), agent.policy.models, 0.01)  # type: ignore[attr-defined]
    assert agent.policy.gain == pytest.approx(gain, rel=0.01)  # type: ignore[attr-defined]
    assert agent.policy.gain != pytest.approx(of_ip02.policy.gain, rel=0.1)  # type: ignore[attr-defined]


def test_a_period_for_an_agent_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"^control_period: an agent drives with that of its training; leave"
    ):
        load_settings(EvaluateConfig, {"run": "pretrained/medium", "control_period": 0.01})


def test_a_learned_model_has_its_own_rig() -> None:
    learned = {"run": "lqr", "plant": "learned", "plant.model": "model", "cart": "stepper"}
    with pytest.raises(ConfigError, match=r"^cart: plant=learned"):
        load_settings(EvaluateConfig, learned)


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
