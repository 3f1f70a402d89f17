"""The pretrained agent of the medium pole, exported, and observations from its episodes on random carts."""

from pathlib import Path

import numpy as np
import pytest
import torch

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.exporting.agent import ExportedAgent, Floats
from cartpole_rl.workflows.build import TrainedAgent, exported_agent, new_agent, provenance, trained_agent
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.export import files_of

MEDIUM = Path("pretrained/medium")


@pytest.fixture(scope="session")
def medium_agent() -> TrainedAgent:
    return trained_agent(MEDIUM)


@pytest.fixture(scope="session")
def exported(medium_agent: TrainedAgent) -> ExportedAgent:
    return exported_agent(medium_agent, provenance(MEDIUM, medium_agent))


@pytest.fixture(scope="session")
def page(exported: ExportedAgent, medium_agent: TrainedAgent) -> str:
    return files_of("web", exported, medium_agent)["cart.html"].decode()


@pytest.fixture(scope="session")
def balancing() -> TrainedAgent:
    """An untrained agent that starts upright."""
    training = load_settings(TrainConfig, {"task": "balance", "agent.hidden": [8], "compile": False})
    return TrainedAgent(training, new_agent(training).greedy_policy())


@pytest.fixture(scope="session")
def balancing_page(balancing: TrainedAgent) -> str:
    return files_of("web", exported_agent(balancing, {}), balancing)["cart.html"].decode()


@pytest.fixture(scope="session")
def observed(medium_agent: TrainedAgent) -> tuple[Floats, Floats]:
    """Observations [M, K] of whole episodes on randomized carts, and their action values [M, A]."""
    training = medium_agent.training
    env = simulated_env(training, training.plant, 20, training.task.evaluation_start, seed=7)
    observations, values, current = [], [], env.reset()
    with torch.no_grad():
        for _ in range(400):
            chosen = medium_agent.policy(current.select("observation"))
            observations.append(current["observation"].numpy())
            values.append(chosen["action_value"].numpy())
            current = env.step(current.set("action", chosen["action"]))["next"].exclude("reward")
    return np.ascontiguousarray(np.concatenate(observations)), np.concatenate(values)
