"""A fine-tuning that was stopped and resumed learns as if it had not stopped."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.errors import CheckpointError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.files import write_bytes
from cartpole_rl.learning.checkpoints import AgentCheckpoint, save_agent
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import new_agent
from cartpole_rl.workflows.build import evaluated_settings
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetune import evaluation_config, started_from
from cartpole_rl.workflows.finetuning_files import FinetuningFiles
from cartpole_rl.workflows.finetuning_learner import CartLearner
from cartpole_rl.workflows.loading import load_settings
from cartpole_rl.workflows.run_folder import write_config

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


def test_a_refit_that_fails_keeps_the_earlier_fit(
    recorded: list[Episode], capsys: pytest.CaptureFixture[str]
) -> None:
    """An encoder came loose in the last episode: learning goes on."""
    first, *others = recorded
    learned = learner()
    learned.start([first])
    carts, capacity = learned.carts.clone(), len(learned.started.buffer)
    jumps = np.random.default_rng(0).integers(-(10**6), 10**6, first.counts.shape)
    learned.refit([first, *(replace(each, counts=each.counts + jumps) for each in others)])
    assert "the simulator keeps its earlier fit: no cart moves as" in capsys.readouterr().err.splitlines()[-1]
    assert torch.equal(learned.carts, carts)
    assert len(learned.started.buffer) == capacity
    learned.round()
    assert learned.started.iteration == CONFIG.finetuning.iterations


@pytest.fixture
def interrupted(tmp_path: Path) -> FinetuningFiles:
    """An interrupted fine-tuning whose copy of the agent is missing."""
    agent = tmp_path / "agent.pt"
    save_agent(agent, AgentCheckpoint({}, {}, transitions=10, score=None))
    config = CONFIG.model_copy(update={"run": agent})
    write_config(tmp_path / "run", "finetune", config.model_dump(mode="json"), agent=agent)
    return FinetuningFiles(tmp_path / "run", config)


def test_without_its_copy_of_the_agent_it_takes_the_same_one(interrupted: FinetuningFiles) -> None:
    assert started_from(interrupted) == interrupted.config.run
    write_bytes(interrupted.start, b"a copy")
    assert started_from(interrupted) == interrupted.start


def test_without_its_copy_of_the_agent_another_one_is_refused(interrupted: FinetuningFiles) -> None:
    run = interrupted.config.run
    save_agent(run, AgentCheckpoint({}, {}, transitions=20, score=None))
    with pytest.raises(CheckpointError) as raised:
        started_from(interrupted)
    assert str(raised.value) == (
        f"resume={interrupted.folder}: it holds no checkpoints/start.pt, and by provenance.json the agent of "
        f"run={run} is not the one that it started from; cartpole-finetune run={run} starts anew"
    )


def test_a_state_that_lacks_a_part_is_named(recorded: list[Episode]) -> None:
    learned = learner()
    learned.start(recorded[:1])
    state = learned.snapshot()
    for part in ("carts", "chooser", "optimizer"):
        with pytest.raises(CheckpointError, match=rf"its state lacks '{part}'; start anew"):
            learner().restore(recorded[:1], {name: value for name, value in state.items() if name != part})


def test_a_learner_that_starts_later_continues_the_schedules(recorded: list[Episode]) -> None:
    """Without the state of the earlier one: it was on a machine that is gone."""
    whole = learner()
    whole.start(recorded[:1])
    for _ in range(2):
        whole.round()
    late = learner()
    late.start(recorded, rounds=2)
    assert late.started.iteration == whole.started.iteration == 6
    shares = [each.started.settings.exploration(each.started.transitions) for each in (late, whole)]
    assert shares[0] == shares[1] < late.started.settings.epsilon[0]


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
