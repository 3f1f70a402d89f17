"""Build plants, environments and agents from checked configs."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from cartpole_rl.agents.baseline import EnergyAndRegulator
from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.make import CartPoleEnv, make_env
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.learning.checkpoints import load_agent, restore_weights
from cartpole_rl.physics.bounds import check_names
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import UNDER_WAY
from cartpole_rl.plants.emulated import emulated_plant
from cartpole_rl.plants.learned import LearnedPlant
from cartpole_rl.plants.learned_model import LearnedModel, load_model
from cartpole_rl.plants.serial.faults import Confirm, nobody
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.specs import Plant
from cartpole_rl.randomization.draws import Draws
from cartpole_rl.randomization.identified import IdentifiedCarts, identified_carts
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.settings import IdentifiedSettings
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.settings import Start, StartSettings
from cartpole_rl.workflows.checking import checked
from cartpole_rl.workflows.checks import BASELINE, check_has_agent, check_model, simulated_carts
from cartpole_rl.workflows.config import (
    CartPoleSettings,
    EmulatedSettings,
    EvaluateConfig,
    LearnedSettings,
    SimulatedSettings,
    TrainConfig,
)

LATER: dict[str, dict[str, Any]] = {  # settings that older checkpoints do not know, as they were then
    "cart": {"pole_coulomb": 0.0},
    "learning": {"retry_probability": 0.0, "carry": False},
}
SIMILAR = 0.1  # share by which a pole's length may differ from a learned model's
REPLACEABLE = ("cart", "cart_friction", "pole_friction", "pole", "reward")  # by an evaluation; and the task


def randomizer(config: CartPoleSettings) -> Draws:
    """What draws the carts that `config` describes. Raises ConfigError where its numbers make no sense."""
    if isinstance(config.randomization, IdentifiedSettings):
        return identified_carts(config.randomization, config.nominal, config.pole)
    return Randomizer(config.nominal, config.pole, config.randomization)


def simulated_env(
    config: CartPoleSettings,
    plant: SimulatedSettings | LearnedSettings,
    carts: int,
    start: StartSettings,
    seed: int,
    compiled: bool = False,
) -> CartPoleEnv:
    """An environment over `carts` simulated carts that start as `start` says. Raises CheckpointError."""
    if isinstance(plant, LearnedSettings):
        return environment(config, learned_plant(config, plant, carts, start, seed, compiled))
    return environment(
        config,
        SimulatedPlant(
            carts,
            randomizer(config),
            start,
            config.models(plant),
            config.control_period,
            plant.substeps,
            seed,
            compiled=compiled,
        ),
    )


def learned_plant(
    config: CartPoleSettings,
    plant: LearnedSettings,
    carts: int,
    start: StartSettings,
    seed: int,
    compiled: bool,
) -> LearnedPlant:
    """Carts of a learned model. Raises ConfigError where it is of another cart than `config` describes."""
    model = load_model_of(plant)
    own, length = model.parameters, 2 * config.pole.nominal.pole_com
    if not math.isclose(model.period, config.control_period, rel_tol=1e-6):
        raise ConfigError(f"control_period={config.control_period}: plant.model has {model.period} s")
    if model.models.actuator != config.actions.actuator:
        raise ConfigError(f"actions: plant.model has actuator {model.models.actuator}")
    if config.pole.choices is None or len(config.pole.choices) > 1:
        raise ConfigError(
            f"pole: plant.model has one pole, not {config.pole.name}; choose it, as pole=medium"
        )
    if abs(2 * own["pole_com"] / length - 1) > SIMILAR:
        raise ConfigError(f"pole: plant.model has one of {2 * own['pole_com']:.2f} m, not {length:.2f} m")
    found = torch.tensor([[own[name]] for name in CartParameters.names()])
    draws = IdentifiedCarts(found, randomizer(config), plant.prior_share, UNDER_WAY * model.period)
    return LearnedPlant(carts, model, draws, start, seed, compiled=compiled)


def load_model_of(plant: LearnedSettings) -> LearnedModel:
    """The model that plant.model= names. Raises CheckpointError, ConfigError."""
    check_model(plant)
    return load_model(plant.model)


def environment(config: CartPoleSettings, plant: Plant) -> CartPoleEnv:
    """The environment that `config` describes, over `plant`."""
    return make_env(plant, config.actions, config.task, config.observation, config.reward)


def new_agent(config: TrainConfig) -> QAgent:
    """An untrained agent."""
    observation = config.observation
    return QAgent(config.agent, observation.mirror_signs, len(config.actions.motors), observation.frames)


def recorded_config(config: Mapping[str, Any], source: str) -> TrainConfig:
    """The config in a checkpoint. Raises CheckpointError where this version has other settings."""
    try:
        known = {group: LATER[group] | config[group] for group in LATER}
        return checked(TrainConfig, {**config, **known})
    except ConfigError as error:
        raise CheckpointError(f"{source} is of another version of this package: {error}") from None


@dataclass(frozen=True)
class TrainedAgent:
    """A policy from a checkpoint, and the settings it was trained with."""

    training: TrainConfig
    policy: Policy


def trained_agent(run: Path) -> TrainedAgent:
    """The agent of a run folder or checkpoint file. Raises CheckpointError."""
    check_has_agent(run)
    checkpoint = load_agent(run)
    training = recorded_config(checkpoint.config, f"run={run}")
    agent = new_agent(training)
    restore_weights(agent, checkpoint.weights, f"run={run}")
    return TrainedAgent(training, agent.greedy_policy())


def evaluated_agent(config: EvaluateConfig, baseline: TrainConfig | None = None) -> TrainedAgent:
    """The agent of config.run, or the baseline controller. Raises CheckpointError, ConfigError.

    `baseline` describes the cart that the controller is made for, and what it observes.
    """
    if config.run != BASELINE:
        return trained_agent(config.run)
    if baseline is None:
        raise ConfigError(f"run={BASELINE} needs the settings of the cart that it is made for")
    return baseline_agent(config, baseline)


def baseline_agent(config: EvaluateConfig, training: TrainConfig) -> TrainedAgent:
    """Energy and LQR, for the cart of `training` with the pole that `config` puts on it.

    Raises ConfigError where there may be several poles.
    """
    poles = evaluated_settings(training, config.model_copy(update={"parameters": None})).pole
    if poles.choices is None or len(poles.choices) > 1:
        raise ConfigError(
            f"run={BASELINE} is made for one pole, not {poles.name}; choose one, as pole=medium"
        )
    policy = EnergyAndRegulator(
        {**training.nominal, **poles.nominal.model_dump()},
        training.models(training.plant),
        training.actions.motors,
        training.observation.kind,
        training.observation.past_motors,
        training.control_period,
    )
    return TrainedAgent(training, policy)


def evaluated_settings(training: TrainConfig, config: EvaluateConfig) -> CartPoleSettings:
    """What the agent was trained on, with what `config` puts in its place. Raises ConfigError."""
    own = {name: getattr(training, name) for name in CartPoleSettings.model_fields}
    given = {name: value for name in REPLACEABLE if (value := getattr(config, name)) is not None}
    if config.task is not None:
        given["task"] = {**config.task, "x_max": config.task.get("x_max") or training.task.x_max}
    if isinstance(config.plant, EmulatedSettings):
        given["pole"] = emulated_pole(config.emulator)
    if isinstance(config.plant, LearnedSettings):
        found = load_model_of(config.plant).parameters
        given["pole"] = one_pole(Pole(**{name: found[name] for name in Pole.model_fields}))
    settings = checked(CartPoleSettings, {**own, **given, "randomization": config.randomization})
    return with_parameters(settings, config.parameters or {})


def emulated_pole(truth: EmulatorSettings) -> PoleSettings:
    """The pole that the emulated cart carries, named by its length."""
    return one_pole(Pole(**truth.model_dump(include=set(Pole.model_fields))))


def one_pole(pole: Pole) -> PoleSettings:
    """The choice of this pole, named by its length."""
    return PoleSettings(choices={f"{2 * pole.pole_com:.2f} m": pole})


def with_parameters(settings: CartPoleSettings, parameters: Mapping[str, float]) -> CartPoleSettings:
    """`settings` with `parameters` of cart and pole in place of their own. Raises ConfigError."""
    check_names(parameters)
    of_pole = {name: value for name, value in parameters.items() if name in Pole.model_fields}
    of_cart = {name: value for name, value in parameters.items() if name not in Pole.model_fields}
    if of_pole and settings.pole.choices is None:
        raise ConfigError(
            f"parameters: the rod's length gives its {', '.join(of_pole)}; choose one pole, as pole=medium"
        )
    poles = {name: pole.model_copy(update=of_pole) for name, pole in (settings.pole.choices or {}).items()}
    return settings.model_copy(
        update={
            "cart": {**settings.nominal, **of_cart},
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
    """The environment to evaluate on: simulated with a cart an episode, or one cart behind a port.

    `prompt` shows a person what to do, `confirm` asks whether a latched fault may be cleared.
    """
    start = settings.task.evaluation_start
    carts, seed = simulated_carts(config), evaluation_seed(config.seed)
    if isinstance(config.plant, LearnedSettings):
        found = config.plant.model_copy(update={"prior_share": 0.0})
        return simulated_env(settings, found, carts, start, seed)
    if isinstance(config.plant, SimulatedSettings):
        return simulated_env(settings, config.plant, carts, start, seed)
    if start.angle is Start.ANY:
        raise ConfigError("task.evaluation_start.angle=any: a cart can start only upright or hanging")
    angle: Literal["hanging", "upright"] = "upright" if start.angle is Start.UPRIGHT else "hanging"
    if isinstance(config.plant, EmulatedSettings):
        truth = config.emulator.model_copy(
            update={"start": angle, "seed": config.emulator.seed + config.seed}
        )
        plant = emulated_plant(truth, settings.control_period, prompt, config.plant.rehome)
        return environment(settings, plant)
    serial = SerialPlant(config.plant, angle, settings.control_period, prompt, confirm=confirm)
    return environment(settings, serial)


def use_threads(threads: int | None) -> None:
    """Set how many threads torch computes with; None leaves its own choice."""
    if threads is not None:
        torch.set_num_threads(threads)
