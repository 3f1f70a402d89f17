"""Agents: new ones, those in checkpoints, the controller of run=lqr, and agents as plain numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from cartpole_rl.agents.baseline import EnergyAndRegulator
from cartpole_rl.checking import validated
from cartpole_rl.envs.build import with_fitted_guard
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.exporting.agent import ExportedAgent, Layer, canonical_json, description
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import AgentCheckpoint, load_agent, restore_weights
from cartpole_rl.randomization.poles import PoleSettings, check_one_pole
from cartpole_rl.run_folder import BASELINE, CHECKPOINTS, find_agent, recorded_provenance
from cartpole_rl.workflows.build import replaced_settings, without_guard_numbers
from cartpole_rl.workflows.checks import check_has_agent
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings, recorded_settings
from cartpole_rl.workflows.poles import guard_holds

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
    return [training.pole, *(validated(PoleSettings, poles) for poles in checkpoint.tuned_poles)]


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


def compiled_training(trained: TrainedAgent) -> TrainConfig:
    """Return the settings that an agent is exported with: its training's, with a guard for all `known_poles`.

    An agent may have been fine-tuned on a pole that was not in its training, and nobody can tell the board
    which one it drives.
    """
    training = with_fitted_guard(trained.training)
    if training.guard.active is None:
        return training
    others = [pole for pole in trained.known_poles if not guard_holds(training.pole, pole)]
    driven = [without_guard_numbers(training).model_copy(update={"pole": pole}) for pole in others]
    guards = [each.guard.active for each in (training, *map(with_fitted_guard, driven)) if each.guard.active]
    numbers = reduce(TrackGuard.at_least, guards)
    return training.model_copy(update={"guard": training.guard.model_copy(update={"numbers": numbers})})


def exported_agent(trained: TrainedAgent, origin: Mapping[str, Any]) -> ExportedAgent:
    """Return an agent as plain numbers; `origin` is its `provenance`.

    Raises ConfigError for an agent that cannot be exported, CheckpointError for one that is not finite.
    """
    about = description(compiled_training(trained), trained.training.agent, origin)
    agent = ExportedAgent(about, tuple(Layer(*each) for each in network_of(trained).plain_layers()))
    agent.check("run")
    return agent


def network_of(trained: TrainedAgent) -> Any:
    """Return the network of the greedy policy, from observations to action values. Raises ConfigError."""
    agent = trained.training.agent
    try:
        network = trained.policy.module[0].module  # type: ignore[attr-defined]
        assert callable(network.plain_layers)
    except (AttributeError, TypeError, IndexError):
        own = f"agent.kind={agent.kind}, agent.network={agent.network}"
        raise ConfigError(f"run: an agent with {own} cannot be exported: it has no `plain_layers`") from None
    return network


def provenance(run: Path) -> dict[str, Any]:
    """Return the origin of the agent of `run`: its command, versions, commit, transitions and score."""
    checkpoint, recorded = load_agent(run), provenance_beside(find_agent(run))
    match recorded.get("command"):
        case [str(program), *arguments]:
            command = [Path(program).name, *arguments]
        case _:
            command = []
    return {
        **recorded,
        "command": command,
        "transitions": checkpoint.transitions,
        "score": checkpoint.score,
    }


def provenance_beside(agent: Path) -> dict[str, Any]:
    """Return the provenance.json of the run that wrote `agent`; empty if it is missing or damaged."""
    folder = agent.parent.parent if agent.parent.name == CHECKPOINTS else agent.parent
    recorded = recorded_provenance(folder)
    try:
        canonical_json(recorded)
    except ValueError:  # an infinite number
        return {}
    return recorded
