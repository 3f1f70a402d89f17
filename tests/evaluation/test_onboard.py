"""The policy on the board of an emulated cart drives as this computer does."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from firmwares import needs_compiler

from cartpole_rl.emulator.settings import ONBOARD
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import comparable, run_episodes, run_onboard_episodes
from cartpole_rl.evaluation.metrics import same_as_host
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.workflows.build import (
    TrainedAgent,
    evaluated_env,
    evaluated_settings,
    new_agent,
    trained_agent,
)
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings
from cartpole_rl.workflows.episodes import on_the_board

pytestmark = needs_compiler
AGENT = "pretrained/medium"
WORDS = {
    "run": AGENT,
    "plant": "emulated",
    "task": "swingup",
    "task.time_limit": 150,
    "emulator.firmware": "c",
    "emulator.physics_step": 1e-3,
}


@contextmanager
def driven(policy: Path | None, onboard: bool, **emulator: float) -> Iterator[Iterator[Episode]]:
    """Yield an episode of a new cart, driven by its board or by this computer."""
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    config = load_settings(EvaluateConfig, WORDS)
    truth = config.emulator.model_copy(update={"policy": policy, **emulator})
    config = config.model_copy(update={"emulator": truth})
    agent = trained_agent(Path(AGENT))
    settings = evaluated_settings(agent.training, config)
    with on_the_board(config, agent, settings) as equipped:
        env = evaluated_env(settings, equipped, prompt=print)
    with closing(env):
        run = run_onboard_episodes if onboard else run_episodes
        yield run(env, agent.policy, 1)


def test_without_latency_both_drive_the_same_cart_to_the_same_bytes() -> None:
    """The board chooses at the end of a period, and so does this computer if its commands take no time."""
    episodes = []
    for onboard in (False, True):
        with driven(ONBOARD, onboard, latency=0.0, latency_jitter=0.0) as driving:
            episodes += driving
    host, board = episodes
    assert (board.counts == host.counts).all()
    assert (board.motor == host.motor).all()
    assert np.abs(board.theta).min() < 0.5  # it swings up
    assert (board.time == host.time).all()
    assert board.score.sum() == host.score.sum()
    assert (board.expected == board.motor)[board.compared].all()
    same, compared = same_as_host(board)
    assert same == compared > 50
    assert host.expected is None
    assert board.ended_by == host.ended_by == Ending.TIME


def test_missed_states_are_not_compared() -> None:
    """After a lost state, the computer observes other velocities than the board, and another past."""
    with driven(ONBOARD, onboard=True, frame_loss=0.03) as driving:
        (board,) = driving
    missed = np.diff(board.time) > 0.03
    same, count = same_as_host(board)
    assert missed.any()
    assert not board.compared[missed].any()
    assert 0 < same == count < 150
    assert (board.motor != board.expected).sum() > 0


@pytest.mark.parametrize(
    ("gaps", "memory", "ending", "left_out"),
    [
        ((), 3, Ending.TIME, ()),
        ((4,), 0, Ending.TIME, (4, 5, 6)),
        ((4,), 2, Ending.ANGLE, (4, 5, 6, 7, 8)),
        ((), 2, Ending.TRACK, (9,)),
        ((8,), 2, Ending.FAULT, (8, 9)),
    ],
)
def test_periods_that_are_not_compared(
    gaps: tuple[int, ...], memory: int, ending: str, left_out: tuple[int, ...]
) -> None:
    compared = comparable(np.isin(np.arange(10), gaps), memory, ending)
    assert tuple(np.flatnonzero(~compared)) == left_out


def test_a_recurrent_agent_is_refused() -> None:
    training = load_settings(TrainConfig, {"agent": "recurrent", "observation": "positions"})
    agent = TrainedAgent(training, new_agent(training).greedy_policy())
    config = load_settings(EvaluateConfig, {**WORDS, "emulator.policy": "onboard"})
    settings = evaluated_settings(training, config)
    with pytest.raises(ConfigError, match="a recurrent agent"), on_the_board(config, agent, settings):
        pass
