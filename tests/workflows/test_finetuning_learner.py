"""Recorded transitions for fine-tuning equal what the agent observed while driving."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.settings import (
    BufferSettings,
    FinetuningSettings,
    LearningSettings,
    OptimizerSettings,
)
from cartpole_rl.plants.specs import Plant
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.finetuning_learner import Finetuning, recorded_chunks

Over = Callable[..., CartPoleEnv]
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


@pytest.fixture(scope="module")
def over(make_environment: Callable[..., CartPoleEnv]) -> Callable[..., CartPoleEnv]:
    """Environments over a plant."""
    return partial(make_environment, motors=MOTORS, time_limit=40)


@pytest.fixture(scope="module")
def drive(over: Over, make_plant: Callable[..., Plant]) -> Callable[..., tuple[Episode, Tensor]]:
    """An episode of random motor values, and the observations [T, K] that they were chosen on."""

    def driven(observation: dict[str, Any], **plant: Any) -> tuple[Episode, Tensor]:
        random, seen = torch.Generator().manual_seed(0), []

        def policy(present: TensorDictBase) -> TensorDictBase:
            seen.append(present["observation"].clone())
            return present.set("action", torch.randint(len(MOTORS), (1,), generator=random))

        (episode,) = run_batch(over(make_plant(1, **plant), **observation), policy)
        return episode, torch.cat(seen)

    return driven


@pytest.fixture(scope="module")
def make_learner(over: Over, make_plant: Callable[..., Plant]) -> Callable[..., tuple[Finetuning, QAgent]]:
    """A fine-tuning of a new agent on 16 simulated carts, and the agent."""

    def build(
        chunks: list[TensorDict], cart_share: float, seed: int = 0, **observation: Any
    ) -> tuple[Finetuning, QAgent]:
        env = over(make_plant(16), **observation)
        observed = env.hardware.observation_settings
        agent = QAgent(DQN, observed.mirror_signs, len(MOTORS), observed.frames)
        finetuning = choice("finetuning/gentle") | {"iterations": 3, "cart_share": cart_share}
        settings = (
            FinetuningSettings(**finetuning),
            LearningSettings(**LEARNING).at(0.02),
            BufferSettings(**choice("buffer/uniform") | {"size": 5000}),
            OptimizerSettings(**choice("optimizer/adam")),
        )
        learner = Finetuning(*settings, agent, env, list, None, seed)
        learner.add(chunks)
        learner.fill()
        return learner, agent

    return build


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_has_what_the_agent_saw_and_tunes_it(
    over: Over, drive: Callable, make_learner: Callable, kind: str
) -> None:
    """Of every kind of observation, the length of the pole included; no weight turns into something else."""
    observation = observation_settings(kind)
    episode, seen = drive(observation)
    (chunk,) = recorded_chunks(episode, partial(over, **observation), MOTORS, LENGTH)
    torch.testing.assert_close(chunk["observation"][0], seen)
    assert all(value.isfinite().all() for value in chunk.values(True, True) if value.is_floating_point())

    if kind != "history_length":  # the learner is the same for all
        return
    learner, agent = make_learner([chunk], cart_share=0.5, **observation)
    before = {name: weight.clone() for name, weight in agent.named_parameters()}
    learner.round()
    after = dict(agent.named_parameters())
    assert any(not torch.equal(after[name], weight) for name, weight in before.items())
    assert all(weight.isfinite().all() for weight in after.values())


def test_a_recording_is_observed_with_its_own_encoders(over: Over, drive: Callable) -> None:
    rig = hardware_of({"cart_nanometres_per_count": 40_000, "pole_counts_per_turn": 2400})
    episode, seen = drive({}, hardware=rig)
    (chunk,) = recorded_chunks(episode, over, MOTORS, None, rig)
    assert episode.encoders == rig.encoders
    torch.testing.assert_close(chunk["observation"][0], seen)


def test_the_seed_chooses_the_recorded_transitions(
    over: Over, drive: Callable, make_learner: Callable
) -> None:
    chunks = recorded_chunks(drive({})[0], over, MOTORS, None)
    batches = [make_learner(chunks, 1.0, seed)[0].sample()["observation"] for seed in (5, 5, 6)]
    assert torch.equal(batches[0], batches[1])
    assert not torch.equal(batches[0], batches[2])


def test_unmeasured_transitions_are_left_out(over: Over, drive: Callable) -> None:
    """The last counts are repeated where the link is lost: as if the cart had stopped at once."""
    episode, _ = drive({})
    lost = replace(episode, ended_by="link")
    (whole,), (chunk,) = (recorded_chunks(each, over, MOTORS, None) for each in (episode, lost))
    assert chunk.shape[1] == lost.measured_steps == whole.shape[1] - 1
    torch.testing.assert_close(chunk["next", "observation"], whole["next", "observation"][:, :-1])
    assert not chunk["next", "done"].any()
    braked = replace(episode, motor=np.where(np.arange(episode.steps) // 2 == 5, 255, episode.motor))
    chunks = recorded_chunks(braked, over, MOTORS, None)
    assert [each.shape[1] for each in chunks] == [10, whole.shape[1] - 12]
    after = whole["observation"][:, 12:]
    assert not torch.equal(chunks[1]["observation"][:, 0], after[:, 0])  # it observes the brake's values, ...
    torch.testing.assert_close(chunks[1]["observation"][:, -1], after[:, -1])  # ... until they are too old
    late = replace(episode, time=episode.time + 0.04 * (np.arange(episode.steps + 1) > 20))
    assert [each.shape[1] for each in recorded_chunks(late, over, MOTORS, None)] == [20, whole.shape[1] - 21]
    only = replace(lost, **{name: getattr(lost, name)[:1] for name in ("motor", "score", "reward")})
    assert recorded_chunks(only, over, MOTORS, None) == []


def test_a_recorded_fall_stays_one_although_its_angle_is_none(over: Over, drive: Callable) -> None:
    """Other arithmetic may see a pole that is right at its limit on the other side of it."""
    episode, _ = drive({})
    fallen = replace(episode, ended_by="angle")
    (whole,), (chunk,) = (recorded_chunks(each, over, MOTORS, None) for each in (episode, fallen))
    for name in ("terminated", "done"):
        assert chunk["next", name].flatten().tolist() == [False] * (episode.steps - 1) + [True]
    assert torch.equal(chunk["next", "reward"], whole["next", "reward"])  # no penalty of the track's end


def test_a_length_that_is_observed_but_not_known_is_an_error(over: Over, drive: Callable) -> None:
    with pytest.raises(ConfigError, match="observes the pole's length"):
        recorded_chunks(drive({})[0], partial(over, pole_length=True), MOTORS, None)
