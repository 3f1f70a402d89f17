"""A small network learns what an agent does, from the states that both visit."""

from copy import deepcopy
from pathlib import Path

import torch

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.distillation import Distillation
from cartpole_rl.learning.settings import DistillationSettings
from cartpole_rl.workflows.agents import new_agent, trained_agent
from cartpole_rl.workflows.config import DistillConfig, load_settings
from cartpole_rl.workflows.distill import student_settings

CONFIG = load_settings(DistillConfig, {"run": "pretrained/medium", "hidden": [16, 16]})
SMALL = DistillationSettings(
    carts=32,
    rounds=4,
    periods=60,
    updates=200,
    batch_size=128,
    learning_rate=1e-2,
    epsilon=0.02,
    value_weight=0.02,
)


def small_distillation() -> tuple[Distillation, QAgent, CartPoleEnv]:
    torch.manual_seed(0)
    teacher = trained_agent(Path("pretrained/medium"))
    training = student_settings(teacher.training, CONFIG)
    student = new_agent(training)
    env = simulated_env(training, training.plant, SMALL.carts, training.task.start, seed=0)
    assert isinstance(teacher.policy, torch.nn.Module)
    drivers = DrivingPolicy(teacher.policy), DrivingPolicy(student.greedy_policy())
    return Distillation(SMALL, drivers[0], student, drivers[1], env, seed=0), student, env


def agreement(student: QAgent, distillation: Distillation) -> float:
    """Return the share of the visited states in which the student chooses the teacher's action."""
    observations, values = torch.cat(distillation._observations), torch.cat(distillation._values)
    with torch.no_grad():
        chosen = student.greedy_policy().module[0].module(observations).argmax(-1)
    return float((chosen == values.argmax(-1)).float().mean())


def test_the_student_comes_to_choose_as_the_teacher_does() -> None:
    distillation, student, _ = small_distillation()
    untrained = deepcopy(student)
    losses = list(distillation.run())
    assert len(losses) == SMALL.rounds
    assert losses[-1] < losses[0] / 2
    assert distillation.transitions == SMALL.carts * SMALL.rounds * SMALL.periods
    assert agreement(student, distillation) > agreement(untrained, distillation) + 0.2
    assert torch.isfinite(torch.cat([weight.flatten() for weight in student.parameters()])).all()


def test_it_is_repeatable() -> None:
    first, second = (small_distillation()[0] for _ in range(2))
    losses = [next(each.run()) for each in (first, second)]
    assert losses[0] == losses[1]


def test_the_student_observes_and_acts_as_the_teacher_with_another_network() -> None:
    teacher = trained_agent(Path("pretrained/medium")).training
    student = student_settings(teacher, CONFIG)
    assert student.agent.hidden == (16, 16)
    assert student.observation == teacher.observation
    assert student.actions == teacher.actions
    assert student.guard.active == teacher.guard.active
