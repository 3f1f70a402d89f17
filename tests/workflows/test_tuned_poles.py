"""A fine-tuned agent knows the pole of its cart, in whatever file it is, and is exported for it."""

from dataclasses import replace
from pathlib import Path

import pytest

from cartpole_rl.choices import group_choices
from cartpole_rl.envs.build import with_fitted_guard, with_guard_numbers
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.learning.checkpoints import AgentCheckpoint, save_agent
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.workflows.build import (
    compiled_training,
    evaluated_settings,
    exported_agent,
    new_agent,
    together,
    trained_agent,
)
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings
from cartpole_rl.workflows.episodes import on_the_board
from cartpole_rl.workflows.finetuning_cart import Stage
from cartpole_rl.workflows.finetuning_learner import TunedAgent

MEDIUM, LARGE = (PoleSettings(**group_choices("pole")[name]) for name in ("medium", "large"))
ROD = PoleSettings(choices={"0.50 m": Pole.rod(0.5)})


@pytest.fixture(scope="module")
def training() -> TrainConfig:
    return load_settings(TrainConfig, {"agent.hidden": [8]})


@pytest.fixture
def agent(training: TrainConfig) -> AgentCheckpoint:
    """An agent of the medium pole."""
    return AgentCheckpoint(training.model_dump(mode="json"), new_agent(training).state_dict(), 1000, 10.0)


def saved(agent: AgentCheckpoint, path: Path) -> list[PoleSettings]:
    """The poles that an agent knows after it is saved and loaded."""
    save_agent(path, agent)
    return trained_agent(path).known_poles


@pytest.mark.parametrize(
    ("kept", "driven", "known"),
    [
        (Stage.AFTER, LARGE, [MEDIUM, LARGE]),
        (Stage.AFTER, MEDIUM, [MEDIUM]),
        (Stage.BEFORE, LARGE, [MEDIUM]),
    ],
)
def test_the_tuned_agent_knows_another_pole(
    kept: Stage,
    driven: PoleSettings,
    known: list[PoleSettings],
    training: TrainConfig,
    agent: AgentCheckpoint,
    tmp_path: Path,
) -> None:
    kept_agent = TunedAgent(training, agent, None).checkpoint(kept, 20.0, driven)
    assert kept_agent.score == 20.0
    assert saved(kept_agent, tmp_path / "last.pt") == known


def test_a_second_fine_tuning_keeps_the_pole_of_the_first(
    training: TrainConfig, agent: AgentCheckpoint, tmp_path: Path
) -> None:
    once = TunedAgent(training, agent, None).checkpoint(Stage.AFTER, 20.0, LARGE)
    twice = TunedAgent(training, once, None).checkpoint(Stage.AFTER, 30.0, ROD)
    assert saved(twice, tmp_path / "last.pt") == [MEDIUM, LARGE, ROD]


def test_it_is_exported_with_a_track_guard_for_all_poles_that_it_knows(
    training: TrainConfig, agent: AgentCheckpoint, tmp_path: Path
) -> None:
    """A board drives with what was compiled for it, and this computer compares with that."""
    training = with_fitted_guard(training)
    agent = replace(agent, config=training.model_dump(mode="json"))
    of_pole = {
        name: with_fitted_guard(load_settings(TrainConfig, {"pole": name})).guard.active
        for name in ("medium", "large")
    }
    numbers = {}
    for name, driven in (("medium", MEDIUM), ("large", LARGE)):
        save_agent(tmp_path / name, TunedAgent(training, agent, None).checkpoint(Stage.AFTER, 20.0, driven))
        tuned = trained_agent(tmp_path / name)
        numbers[name] = exported_agent(tuned, {}).description.guard
        cart = {"plant": "serial", "plant.port": "port", "plant.policy": "onboard"}
        config = load_settings(EvaluateConfig, {"run": tmp_path / name, **cart})
        settings = evaluated_settings(compiled_training(tuned), config)
        assert settings.guard.active == numbers[name]
        with on_the_board(config, tuned, settings) as equipped:  # not refused
            assert equipped == config
    assert numbers["medium"] == of_pole["medium"]
    assert numbers["large"] == together(of_pole["medium"], of_pole["large"])
    assert [each.pole.length for each in numbers["large"].each] == pytest.approx([0.6604, 0.3556])


@pytest.mark.usefixtures("all_carts")
def test_an_agent_of_the_large_pole_that_was_tuned_on_a_shorter_one_keeps_its_guard(
    agent: AgentCheckpoint, tmp_path: Path
) -> None:
    training = with_fitted_guard(load_settings(TrainConfig, {"agent.hidden": [8], "pole": "large"}))
    agent = replace(agent, config=training.model_dump(mode="json"))
    save_agent(tmp_path / "agent", TunedAgent(training, agent, None).checkpoint(Stage.AFTER, 20.0, MEDIUM))
    compiled = compiled_training(trained_agent(tmp_path / "agent")).guard.active
    assert compiled.also == training.guard.active


def test_an_agent_of_an_earlier_version_keeps_its_guard_beside_that_of_another_pole(
    training: TrainConfig, agent: AgentCheckpoint, tmp_path: Path
) -> None:
    earlier = TrackGuard(margin=0.01, delay=0.1, deceleration=6.0)
    agent = replace(agent, config=with_guard_numbers(training, earlier).model_dump(mode="json"))
    assert set(agent.config["guard"]["numbers"]) == {"margin", "delay", "deceleration"}
    save_agent(tmp_path / "agent", TunedAgent(training, agent, None).checkpoint(Stage.AFTER, 20.0, LARGE))
    compiled = compiled_training(trained_agent(tmp_path / "agent")).guard.active
    assert compiled.also == earlier
    assert compiled.pole.length == pytest.approx(0.6604)


def test_a_checkpoint_without_tuned_poles_is_read(agent: AgentCheckpoint, tmp_path: Path) -> None:
    del vars(agent)["tuned_poles"]  # as before they were stored
    assert saved(agent, tmp_path / "last.pt") == [MEDIUM]
