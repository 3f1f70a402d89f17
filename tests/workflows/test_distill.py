"""A small network learns what an agent does, from the states that both visit."""

from copy import deepcopy
from pathlib import Path

import pytest
import torch

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.settings import DistillationSettings
from cartpole_rl.workflows.build import TrainedAgent, new_agent, trained_agent
from cartpole_rl.workflows.config import DistillConfig, TrainConfig, load_settings
from cartpole_rl.workflows.distill import Distillation, student_settings

SMALL = DistillationSettings(
    carts=32,
    rounds=4,
    periods=50,
    updates=160,
    batch_size=128,
    learning_rate=1e-2,
    epsilon=0.02,
    value_weight=0.02,
)
Taught = tuple[TrainedAgent, TrainConfig]


@pytest.fixture(scope="module")
def taught() -> Taught:
    """The teacher, and the settings of its student."""
    teacher = trained_agent(Path("pretrained/medium"))
    config = load_settings(DistillConfig, {"run": "pretrained/medium", "hidden": [16, 16]})
    return teacher, student_settings(teacher.training, config)


def small_distillation(taught: Taught) -> Distillation:
    torch.manual_seed(0)
    teacher, training = taught
    student = new_agent(training)
    env = simulated_env(training, training.plant, SMALL.carts, training.task.start, seed=0)
    assert isinstance(teacher.policy, torch.nn.Module)
    drivers = DrivingPolicy(teacher.policy), DrivingPolicy(student.greedy_policy())
    return Distillation(SMALL, drivers[0], student, drivers[1], env, seed=0)


def agreement(student: QAgent, distillation: Distillation) -> float:
    """Return the share of the visited states in which the student chooses the teacher's action."""
    observations, values = torch.cat(distillation._observations), torch.cat(distillation._values)
    with torch.no_grad():
        chosen = student.greedy_policy().module[0].module(observations).argmax(-1)
    return float((chosen == values.argmax(-1)).float().mean())


def test_the_student_comes_to_choose_as_the_teacher_does(taught: Taught) -> None:
    distillation = small_distillation(taught)
    student, untrained = distillation.student, deepcopy(distillation.student)
    losses = list(distillation.run())
    assert len(losses) == SMALL.rounds
    assert losses[-1] < losses[0] / 2
    assert distillation.transitions == SMALL.carts * SMALL.rounds * SMALL.periods
    assert agreement(student, distillation) > agreement(untrained, distillation) + 0.2
    assert all(weight.isfinite().all() for weight in student.parameters())
    assert next(small_distillation(taught).run()) == losses[0]  # it is repeatable


def test_the_student_observes_and_acts_as_the_teacher_with_another_network(taught: Taught) -> None:
    teacher, student = taught[0].training, taught[1]
    assert student.agent.hidden == (16, 16)
    assert student.observation == teacher.observation
    assert student.actions == teacher.actions
    assert student.guard.active == teacher.guard.active
