"""Build plants, environments and agents from checked configs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from cartpole_rl.agents import AgentSettings, QAgent
from cartpole_rl.commands.config import (
    CartPoleSettings,
    EmulatedSettings,
    EvaluateConfig,
    SimulatedSettings,
    TrainConfig,
    checked,
)
from cartpole_rl.envs import CartPoleEnv, make_env
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.learning.checkpoints import AgentCheckpoint, load_agent
from cartpole_rl.physics.parameters import check_names
from cartpole_rl.plants.emulated import emulated_plant
from cartpole_rl.plants.serial import SerialPlant, SerialPlantSettings
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.specs import Plant
from cartpole_rl.tasks.starts import Start, StartSettings


def simulated_env(
    config: CartPoleSettings, plant: SimulatedSettings, carts: int, start: StartSettings, seed: int
) -> CartPoleEnv:
    """An environment over `carts` simulated carts that start as `start` says."""
    return environment(
        config,
        SimulatedPlant(
            carts,
            config.randomizer(),
            start,
            config.models(plant),
            config.control_period,
            plant.substeps,
            seed,
        ),
    )


def environment(config: CartPoleSettings, plant: Plant) -> CartPoleEnv:
    """The environment that `config` describes, over `plant`."""
    return make_env(plant, config.actions, config.task, config.observation, config.reward)


def new_agent(config: TrainConfig) -> QAgent:
    """An untrained agent."""
    return QAgent(config.agent, config.observation.size, len(config.actions.motors))


@dataclass(frozen=True)
class TrainedAgent:
    """A policy from a checkpoint, and the settings it was trained with."""

    checkpoint: AgentCheckpoint
    training: TrainConfig
    policy: Policy


def trained_agent(run: Path) -> TrainedAgent:
    """The agent of a run folder or checkpoint file. Raises CheckpointError."""
    checkpoint = load_agent(run)
    try:
        training = checked(TrainConfig, checkpoint.config)
        agent = new_agent(training)
        agent.load_state_dict(checkpoint.weights)
    except (ConfigError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"{checkpoint.path} was written by another version of this package: {reason}") from None
    return TrainedAgent(checkpoint, training, agent.greedy_policy())


def evaluated_settings(agent: TrainedAgent, config: EvaluateConfig) -> CartPoleSettings:
    """What the agent was trained on, with what `config` puts in its place."""
    given = {
        name: value
        for name in ("cart", "cart_friction", "pole_friction", "pole", "task", "reward")
        if (value := getattr(config, name)) is not None
    }
    shared = {name: getattr(agent.training, name) for name in CartPoleSettings.model_fields}
    settings = CartPoleSettings(**{**shared, **given, "randomization": config.randomization})
    check_names(config.parameters)
    return settings.model_copy(
        update={
            "cart": {**settings.nominal, **config.parameters},
            "cart_friction": settings.cart_friction.model_copy(update={"parameters": {}}),
            "pole_friction": settings.pole_friction.model_copy(update={"parameters": {}}),
        }
    )


def evaluated_env(
    settings: CartPoleSettings, config: EvaluateConfig, prompt: Callable[[str], None]
) -> CartPoleEnv:
    """The environment to evaluate on: simulated with a cart an episode, or one cart behind a port."""
    start = settings.task.evaluation_start
    if isinstance(config.plant, SimulatedSettings):
        return simulated_env(settings, config.plant, min(config.episodes, 1024), start, config.seed)
    if start.angle is Start.ANY:
        raise ConfigError("task.evaluation_start.angle=any: a cart can start only upright or hanging")
    angle = "upright" if start.angle is Start.UPRIGHT else "hanging"
    if isinstance(config.plant, EmulatedSettings):
        truth = config.emulator.model_copy(update={"start": angle, "seed": config.emulator.seed + config.seed})
        return environment(settings, emulated_plant(truth, settings.control_period, prompt))
    serial = SerialPlantSettings(
        port=config.plant.port,
        baud=config.plant.baud,
        pole_length=config.plant.pole_length,
        start=angle,
        control_period=settings.control_period,
    )
    return environment(settings, SerialPlant(serial, prompt))


def use_threads(threads: int | None) -> None:
    """Set how many threads torch computes with; None leaves its own choice."""
    if threads is not None:
        torch.set_num_threads(threads)
