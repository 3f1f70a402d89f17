"""A fine-tuning that was stopped and resumed learns as if it had not stopped."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import new_agent
from cartpole_rl.workflows.build import evaluated_settings
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetune import evaluation_config
from cartpole_rl.workflows.finetuning_learner import CartLearner
from cartpole_rl.workflows.loading import load_settings

TRAINING = load_settings(
    TrainConfig,
    {
        "task.time_limit": 80,
        "learning.carts": 16,
        "learning.chunk": 8,
        "learning.batch_size": 32,
        "learning.updates": 2,
    },
)
CONFIG = load_settings(
    FinetuneConfig,
    {
        "run": "somewhere",
        "seed": 5,
        "episodes": 4,
        "compile": False,
        "finetuning.iterations": 3,
        "finetuning.cart_share": 0.5,
    },
)


def learner() -> CartLearner:
    """A learner with a new agent, the same one each time."""
    seed_everything(3)
    settings = evaluated_settings(TRAINING, evaluation_config(CONFIG))
    return CartLearner(CONFIG, TRAINING, settings, new_agent(TRAINING))


def weights(learned: CartLearner) -> dict[str, Tensor]:
    """A copy of the agent's weights."""
    return {name: weight.clone() for name, weight in learned.agent.state_dict().items()}


def from_disk(state: dict[str, Any]) -> dict[str, Any]:
    """`state` as `save_training` and `load_training` would return it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.fixture(scope="module")
def recorded() -> list[Episode]:
    """Three episodes of random motor values."""
    env = simulated_env(TRAINING, TRAINING.plant, 3, TRAINING.task.start, seed=1)
    random, actions = torch.Generator().manual_seed(0), len(TRAINING.actions.motors)
    return run_batch(
        env, lambda current: current.set("action", torch.randint(actions, (3,), generator=random))
    )


def test_a_resumed_fine_tuning_equals_one_that_was_not_stopped(recorded: list[Episode]) -> None:
    first, *others = recorded
    whole = learner()
    whole.start([first])
    whole.round()
    whole.add(others[0])
    whole.refit([first, others[0]])
    saved = from_disk(whole.snapshot())
    whole.round()
    whole.add(others[1])
    whole.round()

    resumed = learner()
    resumed.agent.load_state_dict(saved["agent"])
    resumed.restore([first, others[0]], saved)
    resumed.round()
    resumed.add(others[1])
    resumed.round()
    assert resumed.started.iteration == 9
    expected = weights(whole)
    assert all(torch.equal(expected[name], weight) for name, weight in weights(resumed).items())


def test_a_learner_that_starts_later_continues_the_schedules(recorded: list[Episode]) -> None:
    """Without the state of the earlier one: it was on a machine that is gone."""
    whole = learner()
    whole.start(recorded[:1])
    for _ in range(2):
        whole.round()
    late = learner()
    late.start(recorded, rounds=2)
    assert late.started.iteration == whole.started.iteration == 6
    assert late.started.epsilon() == whole.started.epsilon() < late.started.settings.epsilon[0]


def test_simulation_brakes_as_the_cart_does(recorded: list[Episode]) -> None:
    """The guard of a cart with another pole is not that of the training."""
    learned = learner()
    numbers = learned.settings.guard.active
    assert numbers is not None
    other = numbers.model_copy(update={"margin": 2 * numbers.margin})
    guard = learned.settings.guard.model_copy(update={"numbers": other})
    learned.settings = learned.settings.model_copy(update={"guard": guard})
    learned.start(recorded[:1])
    assert learned.started.env.hardware.guard == other


def test_what_is_not_learned_from_is_told(
    recorded: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """A late value was replaced by one that the agent cannot choose."""
    odd = replace(recorded[0], motor=np.concatenate((recorded[0].motor[:10], [7], recorded[0].motor[11:])))
    learned = learner()
    assert learned.transitions(odd).shape[1] == 10
    (line,) = capsys.readouterr().err.splitlines()
    steps, motors = odd.measured_steps, list(TRAINING.actions.motors)
    assert line == (
        f"cartpole-finetune: an episode is learned from up to step 10 of {steps}: there the motor value 7 "
        f"drove, which is none of the agent's {motors}"
    )
    assert learned.transitions(recorded[0]).shape[1] == steps
    assert not capsys.readouterr().err
