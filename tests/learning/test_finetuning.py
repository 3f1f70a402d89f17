"""Recorded transitions for fine-tuning equal what the agent observed while driving."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.finetuning import Finetuning, recorded_chunks
from cartpole_rl.learning.settings import (
    BufferSettings,
    FinetuningSettings,
    LearningSettings,
    OptimizerSettings,
)
from cartpole_rl.rig.hardware import hardware_of

MOTORS = (-250, -200, 0, 200, 250)
LENGTH = 2 * 0.1778  # m, the medium pole
KINDS = ("history", "history_length", "positions", "raw")
DQN = AgentSettings(**choice("agent/dqn")).at(0.02)
LEARNING = choice("learning/fast") | {
    "transitions": 2560,
    "carts": 16,
    "chunk": 8,
    "updates": 2,
    "batch_size": 64,
    "warmup_transitions": 0,
}


def observation_settings(kind: str) -> dict[str, Any]:
    """A file of conf/observation, which may build on `history`."""
    own = choice(f"observation/{kind}")
    base = choice("observation/history") if own.pop("defaults", None) else {}
    return {**base, **own}


def drive(make_plant: Callable, make_environment: Callable, observation: dict[str, Any]) -> tuple[Any, Any]:
    """An episode of random motor values, and the observations [T, K] that they were chosen on."""
    env = make_environment(make_plant(1), MOTORS, time_limit=40, **observation)
    random, seen = torch.Generator().manual_seed(0), []

    def policy(present: TensorDictBase) -> TensorDictBase:
        seen.append(present["observation"].clone())
        return present.set("action", torch.randint(len(MOTORS), (1,), generator=random))

    (episode,) = run_batch(env, policy)
    return episode, torch.cat(seen)


def make_learner(
    make_plant: Callable,
    make_environment: Callable,
    observation: dict[str, Any],
    cart_share: float,
    seed: int = 0,
) -> tuple[Finetuning, QAgent]:
    """A fine-tuning of a new agent on 16 simulated carts, and the agent."""
    env = make_environment(make_plant(16), MOTORS, time_limit=40, **observation)
    observed = env.hardware.observation_settings
    agent = QAgent(DQN, observed.mirror_signs, len(MOTORS), observed.frames)
    finetuning = choice("finetuning/gentle") | {"iterations": 3, "cart_share": cart_share}
    learner = Finetuning(
        FinetuningSettings(**finetuning),
        LearningSettings(**LEARNING).at(0.02),
        BufferSettings(**choice("buffer/uniform") | {"size": 5000}),
        OptimizerSettings(**choice("optimizer/adam")),
        agent,
        env,
        list,
        None,
        seed,
    )
    return learner, agent


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_has_what_the_agent_saw_and_tunes_it(
    make_plant: Callable, make_environment: Callable, kind: str
) -> None:
    """Of every kind of observation, the length of the pole included; no weight turns into something else."""
    observation = observation_settings(kind)
    episode, seen = drive(make_plant, make_environment, observation)

    def over(plant: Any) -> Any:
        return make_environment(plant, MOTORS, time_limit=40, **observation)

    (chunk,) = recorded_chunks(episode, over, MOTORS, LENGTH)
    torch.testing.assert_close(chunk["observation"][0], seen)
    assert all(value.isfinite().all() for value in chunk.values(True, True) if value.is_floating_point())

    learner, agent = make_learner(make_plant, make_environment, observation, cart_share=0.5)
    learner.add([chunk])
    learner.fill()
    before = {name: weight.clone() for name, weight in agent.named_parameters()}
    learner.round()
    after = dict(agent.named_parameters())
    assert any(not torch.equal(after[name], weight) for name, weight in before.items())
    assert all(weight.isfinite().all() for weight in after.values())


def test_a_recording_is_observed_with_its_own_encoders(
    make_plant: Callable, make_environment: Callable
) -> None:
    rig = hardware_of({"cart_nanometres_per_count": 40_000, "pole_counts_per_turn": 2400})
    episode, seen = drive(partial(make_plant, hardware=rig), make_environment, {})
    (chunk,) = recorded_chunks(
        episode, lambda plant: make_environment(plant, MOTORS, time_limit=40), MOTORS, None, rig
    )
    assert episode.encoders == rig.encoders
    torch.testing.assert_close(chunk["observation"][0], seen)


def test_the_seed_chooses_the_recorded_transitions(make_plant: Callable, make_environment: Callable) -> None:
    episode, _ = drive(make_plant, make_environment, {})
    env = make_environment
    chunks = recorded_chunks(episode, lambda plant: env(plant, MOTORS, time_limit=40), MOTORS, None)
    batches = []
    for seed in (5, 5, 6):
        learner, _ = make_learner(make_plant, make_environment, {}, cart_share=1.0, seed=seed)
        learner.add(chunks)
        learner.fill()
        batches.append(learner.sample()["observation"])
    assert torch.equal(batches[0], batches[1])
    assert not torch.equal(batches[0], batches[2])


def test_unmeasured_transitions_are_left_out(make_plant: Callable, make_environment: Callable) -> None:
    """The last counts are repeated where the link is lost: as if the cart had stopped at once."""
    episode, _ = drive(make_plant, make_environment, {})
    lost = replace(episode, ended_by="link")
    (whole,), (chunk,) = (
        recorded_chunks(each, lambda plant: make_environment(plant, MOTORS, time_limit=40), MOTORS, None)
        for each in (episode, lost)
    )
    assert chunk.shape[1] == lost.measured_steps == whole.shape[1] - 1
    torch.testing.assert_close(chunk["next", "observation"], whole["next", "observation"][:, :-1])
    assert not chunk["next", "done"].any()
    braked = replace(episode, motor=np.where(np.arange(episode.steps) // 2 == 5, 255, episode.motor))
    env = make_environment
    chunks = recorded_chunks(braked, lambda plant: env(plant, MOTORS, time_limit=40), MOTORS, None)
    assert [each.shape[1] for each in chunks] == [10, whole.shape[1] - 12]
    after = whole["observation"][:, 12:]
    assert not torch.equal(chunks[1]["observation"][:, 0], after[:, 0])  # it observes the brake's values, ...
    torch.testing.assert_close(chunks[1]["observation"][:, -1], after[:, -1])  # ... until they are too old
    only = replace(lost, **{name: getattr(lost, name)[:1] for name in ("motor", "score", "reward")})
    assert recorded_chunks(only, lambda plant: env(plant, MOTORS), MOTORS, None) == []


def test_a_length_that_is_observed_but_not_known_is_an_error(
    make_plant: Callable, make_environment: Callable
) -> None:
    observation = observation_settings("history_length")
    episode, _ = drive(make_plant, make_environment, observation)
    with pytest.raises(ConfigError, match="observes the pole's length"):
        recorded_chunks(episode, lambda plant: make_environment(plant, MOTORS, **observation), MOTORS, None)
