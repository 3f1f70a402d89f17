"""Builds the environment of an evaluation, from the settings of the agent's training and its own."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from cartpole_rl.checking import validated
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import environment, simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.serial.preparation import Confirm, StartPosition, nobody
from cartpole_rl.plants.settings import PlantSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.rig.parameters import check_names
from cartpole_rl.scheduling import taking_precedence
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.settings import ActionSettings, Start
from cartpole_rl.workflows.checks import simulated_carts
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig
from cartpole_rl.workflows.poles import guard_holds, pole_text

REPLACEABLE = (
    "cart",
    "cart_friction",
    "pole_friction",
    "pole",
    "reward",
    "guard",
    "actions",
)  # by an evaluation; and the task
OUTDATING = {"actions": "other full motor values", "pole": "another pole"}  # a guard's numbers, in words


def evaluated_settings(training: TrainConfig, config: EvaluateConfig) -> CartPoleSettings:
    """Return the settings to evaluate with: `replaced_settings` with the numbers of the track guard.

    A new guard is fitted to the carts that `config` randomizes, or else to those of the training: an
    evaluation without randomization may drive a real cart. The guard of the training is fitted anew to the
    settings that make it `outdated`. Raises ConfigError.
    """
    settings = replaced_settings(training, config)
    fitted_to = settings.model_copy(update={"randomization": config.randomization or training.randomization})
    if changes := outdated(training, config):
        fitted_to = without_guard_numbers(training).model_copy(update=changes)
    return settings.model_copy(update={"guard": with_fitted_guard(fitted_to).guard})


def without_guard_numbers(training: TrainConfig) -> TrainConfig:
    """Return `training` with a track guard that is not fitted yet."""
    return training.model_copy(update={"guard": training.guard.model_copy(update={"numbers": None})})


def outdated(training: TrainConfig, config: EvaluateConfig) -> dict[str, Any]:
    """Return the replaced settings for which the numbers of the training's guard do not hold, by name.

    They are what a person knows of a real cart: other full motor values, and a pole that is longer,
    shorter or heavier than those in training.
    Carts that simulation changes in other ways meet the guard that a real one of their kind would meet. The
    guard of a policy on a real board cannot be changed. Raises ConfigError.
    """
    if config.guard is not None or training.guard.active is None or config.plant.has_compiled_agent:
        return {}
    driven = replaced_settings(training, config.model_copy(update={"parameters": None}))
    motors, trained = driven.actions.motors, training.actions
    changes: dict[str, Any] = {}
    if (min(motors), max(motors)) != (min(trained.motors), max(trained.motors)):
        changes["actions"] = trained.model_copy(update={"motors": motors})
    if not guard_holds(training.pole, driven.pole):
        changes["pole"] = driven.pole
    return changes


def guard_note(training: TrainConfig, config: EvaluateConfig, settings: CartPoleSettings) -> str | None:
    """Return a line about the guard of `evaluated_settings` if it was fitted anew, None if not."""
    changes = outdated(training, config)
    if not changes:
        return None
    others = " and ".join(OUTDATING[name] for name in changes)
    pole = f" to {pole_text(settings.pole)}" if "pole" in changes else ""
    return (
        f"note: the track guard of the training is for {others}; fitted anew{pole}: {settings.guard.active}"
    )


def replaced_settings(training: TrainConfig, config: EvaluateConfig) -> CartPoleSettings:
    """Return the settings of the agent's training, with those that `config` replaces. Raises ConfigError."""
    own = {name: getattr(training, name) for name in CartPoleSettings.model_fields}
    given = {name: value for name in REPLACEABLE if (value := getattr(config, name)) is not None}
    if config.task is not None:
        given["task"] = {**config.task.model_dump(), "x_max": config.task.x_max or training.task.x_max}
    if config.pole is None and (own_pole := config.plant.own_pole(config.emulator, training.pole)):
        given["pole"] = own_pole
    if config.actions is not None:
        check_same_meaning(config.actions, training.actions)
    settings = validated(CartPoleSettings, {**own, **given, "randomization": config.randomization})
    return with_parameters(settings, config.parameters or {})


def check_same_meaning(actions: ActionSettings, trained: ActionSettings) -> None:
    """Raise ConfigError unless the motor values have the number, signs and order of those in training."""
    given, known = actions.motors, trained.motors
    if len(given) != len(known):
        raise ConfigError(
            f"actions: {len(given)} motor values, but the agent chooses from {len(known)}; give {len(known)}"
        )
    if order_and_signs(given) != order_and_signs(known):
        raise ConfigError(
            f"actions.motors={[*given]}: the agent would push in other directions than in its training; give "
            f"values with the signs and in the order of {[*known]}"
        )


def order_and_signs(motors: Sequence[int]) -> list[tuple[int, int]]:
    """Return the rank and the sign of each motor value."""
    return [(sorted(motors).index(motor), (motor > 0) - (motor < 0)) for motor in motors]


def predicting_env(settings: CartPoleSettings, plant: PlantSettings, seed: int) -> CartPoleEnv:
    """Return a simulated cart that predicts an episode on a real one. Raises ConfigError."""
    nominal = settings.model_copy(update={"randomization": {}})
    return simulated_env(nominal, plant, 1, settings.task.evaluation_start, evaluation_seed(seed))


def with_parameters(settings: CartPoleSettings, parameters: Mapping[str, float]) -> CartPoleSettings:
    """Return `settings` with `parameters` of the cart and the pole replaced. Raises ConfigError."""
    check_names(parameters, "parameters")
    of_pole = {name: value for name, value in parameters.items() if name in Pole.model_fields}
    of_cart = {name: value for name, value in parameters.items() if name not in Pole.model_fields}
    if of_pole and settings.pole.choices is None:
        raise ConfigError(
            f"parameters: the rod's length gives its {', '.join(of_pole)}; choose one pole, as pole=medium"
        )
    poles = {name: pole.model_copy(update=of_pole) for name, pole in (settings.pole.choices or {}).items()}
    return settings.model_copy(
        update={
            "cart": {**settings.nominal_cart, **of_cart},
            "cart_friction": settings.cart_friction.model_copy(update={"parameters": {}}),
            "pole_friction": settings.pole_friction.model_copy(update={"parameters": {}}),
            "pole": PoleSettings(choices=poles) if poles else settings.pole,
        }
    )


def evaluated_env(
    settings: CartPoleSettings,
    config: EvaluateConfig,
    prompt: Callable[[str], None],
    confirm: Confirm = nobody,
) -> CartPoleEnv:
    """Return the environment to evaluate in: simulated carts, one for each episode, or one cart on a port.

    `prompt` shows a person what to do; `confirm` asks whether a latched fault may be cleared.
    """
    start = settings.task.evaluation_start
    carts, seed = simulated_carts(config), evaluation_seed(config.seed)
    if not config.plant.is_on_port:
        return simulated_env(settings, config.plant.as_evaluated, carts, start, seed)
    if start.angle is Start.ANY:
        raise ConfigError("task.evaluation_start.angle=any: a cart can start only upright or hanging")
    angle: StartPosition = "upright" if start.angle is Start.UPRIGHT else "hanging"
    emulator = config.emulator.model_copy(update={"seed": config.emulator.seed + config.seed})
    plant = config.plant.build(emulator, settings.control_period, angle, prompt, confirm)
    return environment(settings, plant)


def precedence(plant: PlantSettings, emulator: EmulatorSettings) -> AbstractContextManager[None]:
    """Return a context with real-time priority for a cart with its own clock."""
    return taking_precedence() if plant.is_real_time(emulator) else nullcontext()


def use_threads(threads: int | None) -> None:
    """Set the number of torch's threads; None keeps torch's own choice."""
    if threads is not None:
        torch.set_num_threads(threads)
