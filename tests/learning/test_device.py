"""A training on a device: every tensor is there, and what is computed and saved is the same as on the CPU."""

from pathlib import Path
from typing import Any

import pytest
import torch
from separate_device import DEVICE, SeparateTensor, separate_device
from torch import Tensor
from torch.utils._pytree import tree_leaves
from toy_settings import TOY

from cartpole_rl.envs.build import simulated_env, with_fitted_guard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.checkpoints import TrainingCheckpoint, load_training, save_training
from cartpole_rl.learning.dqn import Monitor, Training
from cartpole_rl.learning.states import on_device, seed_everything
from cartpole_rl.workflows.build import new_agent
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import (
    available_device,
    judge_agent,
    nominal_env,
    note_unused_randomization,
    train,
)

SHORT = TOY[TrainConfig] | {
    "learning.transitions": 2048,
    "learning.chunk": 5,
    "learning.updates": 2,
    "learning.batch_size": 32,
    "learning.warmup_transitions": 100,
    "learning.retry_probability": 0.5,
    "buffer.size": 500,
    "task.time_limit": 6,
}


def new_training(overrides: dict[str, Any], device: torch.device | str) -> Training:
    config = with_fitted_guard(load_settings(TrainConfig, SHORT | overrides))
    seed_everything(1)
    env = simulated_env(config, config.plant, config.learning.carts, config.task.start, seed=1, device=device)
    note_unused_randomization(config, env.plant.randomizer, env.plant.models)
    settings = config.learning.at(config.control_period), config.buffer, config.optimizer
    return Training(*settings, new_agent(config, device), env, lambda: [], Monitor(), seed=1)


def trained(training: Training, iterations: int) -> dict[str, Tensor]:
    """Train; return the weights on the CPU."""
    for _ in range(iterations):
        chunk, _ = training.iterate()
        training.describe(chunk)
    return on_device(training.agent.state_dict(), "cpu")


@pytest.mark.filterwarnings("ignore:for .*copying from a non-meta parameter")  # here it is a copy
@pytest.mark.parametrize(
    "overrides",
    [
        {"experiment": "recurrent", "guard": "none", "buffer": "uniform", "learning.carry": True},
        pytest.param(
            {"pole": "range", "observation.pole_length": True, "learning.carry": False},
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_a_training_is_on_its_device_saved_on_the_cpu_and_resumed(
    overrides: dict[str, Any], tmp_path: Path
) -> None:
    expected = trained(new_training(overrides, "cpu"), 4)
    with separate_device():
        training = new_training(overrides, DEVICE)
        trained(training, 2)
        there = [training.env.plant.parameters.table]
        there += training.buffer.storage.get(slice(None)).values(True, True)
        assert all(isinstance(value, SeparateTensor) for value in there)
        save_training(tmp_path, TrainingCheckpoint({}, training.snapshot(), training.transitions))
    saved = torch.load(tmp_path / "checkpoints" / "resume.pt", weights_only=True)  # where it was saved from
    assert {part.device.type for part in tree_leaves(saved) if isinstance(part, Tensor)} == {"cpu"}
    with separate_device():
        resumed = new_training(overrides, DEVICE)
        resumed.restore(load_training(tmp_path).state)
        weights = trained(resumed, 2)
    assert resumed.agent.updates == 6
    assert weights.keys() == expected.keys()
    for name, weight in weights.items():
        assert torch.equal(weight, expected[name]), name


def test_a_training_is_evaluated_on_the_cpu() -> None:
    config = load_settings(TrainConfig, {**SHORT, "guard": "none"})
    with separate_device():
        agent = new_agent(config, DEVICE)
        policy = DrivingPolicy(agent.greedy_policy(), compiled=False)
        episodes = judge_agent(nominal_env(config), agent, policy, seed=3)
        weights = on_device(agent.state_dict(), "cpu")
    on_cpu = new_agent(config)
    on_cpu.load_state_dict(weights)
    policy = DrivingPolicy(on_cpu.greedy_policy(), compiled=False)
    expected_episodes = judge_agent(nominal_env(config), on_cpu, policy, seed=3)
    for episode, expected in zip(episodes, expected_episodes, strict=True):
        assert (episode.counts == expected.counts).all()
        assert (episode.score == expected.score).all()


def test_auto_takes_a_gpu_if_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert available_device("cpu") == "cpu"
    assert available_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert available_device("auto") == available_device("cuda") == "cuda"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_does_not_exist_is_one_line_before_any_work(tmp_path: Path) -> None:
    config = load_settings(TrainConfig, {**SHORT, "device": "cuda"})
    with pytest.raises(ConfigError, match="device=cuda: PyTorch finds no CUDA GPU on this machine"):
        train(config, tmp_path)
    assert list(tmp_path.iterdir()) == []
