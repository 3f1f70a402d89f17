"""Agents: new ones, those in checkpoints, and the controller of run=lqr."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cartpole_rl.agents.baseline import EnergyAndRegulator
from cartpole_rl.checking import checked
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import AgentCheckpoint, load_agent, restore_weights
from cartpole_rl.randomization.poles import PoleSettings, check_one_pole
from cartpole_rl.workflows.build import replaced_settings
from cartpole_rl.workflows.checks import BASELINE, check_has_agent
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings, recorded_settings

OF_BASELINE = {"observation": "raw", "observation.past_motors": 1}


def new_agent(config: TrainConfig, device: str = "cpu") -> QAgent:
    """Return an untrained agent on `device`."""
    observation, actions = config.observation, len(config.actions.motors)
    return config.agent.kind(config.agent, observation.mirror_signs, actions, observation.frames, device)


@dataclass(frozen=True)
class TrainedAgent:
    """A policy, the settings that it was trained with, and its `known_poles`, the newest last."""

    training: TrainConfig
    policy: Policy
    known_poles: Sequence[PoleSettings] = ()


def trained_agent(run: Path) -> TrainedAgent:
    """Return the agent of a run folder or a checkpoint file. Raises CheckpointError, ConfigError."""
    check_has_agent(run)
    checkpoint = load_agent(run)
    training = recorded_settings(TrainConfig, checkpoint.config, f"run={run}")
    agent = new_agent(training)
    restore_weights(agent, checkpoint.weights, f"run={run}")
    return TrainedAgent(training, agent.greedy_policy(), known_poles(training, checkpoint))


def known_poles(training: TrainConfig, checkpoint: AgentCheckpoint) -> list[PoleSettings]:
    """Return the poles that an agent was trained with, and those that it was fine-tuned on.

    Raises ConfigError for a damaged pole.
    """
    return [training.pole, *(checked(PoleSettings, poles) for poles in checkpoint.tuned_poles)]


def evaluated_agent(config: EvaluateConfig) -> TrainedAgent:
    """Return the agent of config.run, or the baseline controller. Raises CheckpointError, ConfigError."""
    if config.run != BASELINE:
        return trained_agent(config.run)
    training = load_settings(TrainConfig, OF_BASELINE)
    return baseline_agent(config, training.model_copy(update={"actions": config.actions or training.actions}))


def baseline_agent(config: EvaluateConfig, training: TrainConfig) -> TrainedAgent:
    """Return energy and LQR for the cart of `training` with the pole of `config`.

    Raises ConfigError for several poles.
    """
    poles = replaced_settings(training, config.model_copy(update={"parameters": None})).pole
    pole = check_one_pole(f"run={BASELINE}", poles)
    policy = EnergyAndRegulator(
        training.nominal_with(pole),
        training.models(training.plant),
        training.actions.motors,
        training.observation.kind,
        training.observation.past_motors,
        training.control_period,
    )
    return TrainedAgent(training, policy)
