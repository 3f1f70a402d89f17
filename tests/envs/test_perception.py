"""From one frame to the next: memory, scores, costs and endings, by hand."""

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch

from cartpole_rl.choices import choice
from cartpole_rl.envs.perception import Percept, Previous, perceive, perceive_first, remember
from cartpole_rl.envs.settings import ObservationSettings
from cartpole_rl.plants.specs import PlantOutput
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.tasks.features import ANGULAR_SPEED_SCALE, MOTOR_SCALE, SPEED_SCALE
from cartpole_rl.tasks.rewards import speed_periods
from cartpole_rl.tasks.settings import RewardSettings, StartSettings, TaskSettings

NO_LENGTH = torch.zeros(0, 2)
TRACK_END = torch.full((1, 2), 0.4)
RAW = ObservationSettings(kind="raw", past_motors=2, past_velocities=1, past_positions=0, pole_length=False)


def of_task(**changes: Any) -> TaskSettings:
    start = StartSettings(**choice("task/swingup")["start"])
    settings = {"name": "test", "start": start, "evaluation_start": start, "time_limit": 9, "x_max": 0.4}
    return TaskSettings(**{"angle_limit": None, **settings, **changes})


def of_reward(**changes: Any) -> RewardSettings:
    return RewardSettings(**{**choice("reward/constant"), **changes})


def previous(steps: int = 3) -> Previous:
    """Two carts at rest at the middle, pole upright; the second one moved before."""
    return Previous(
        counts=torch.zeros(2, 2, dtype=torch.int64),
        state=torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.0, 0.0], [0.0, -2.0]]),
        past=torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [0.7, 0.8]]),
        speeds=torch.zeros(0, 2),
        step_count=torch.full((1, 2), steps),
        motor=torch.tensor([[-255, 51]]),
        length=NO_LENGTH,
        track_end=TRACK_END,
    )


def frame(cart: int = 100, pole: int = 10, terminated: bool = False, truncated: bool = False) -> PlantOutput:
    """The second cart moved by `cart` and `pole` counts in 20 ms, and ended so."""
    return PlantOutput(
        counts=torch.tensor([[0, cart], [0, pole]]),
        dt=torch.full((1, 2), 0.02),
        motor_applied=torch.zeros(1, 2, dtype=torch.int64),
        terminated=torch.tensor([[False, terminated]]),
        truncated=torch.tensor([[False, truncated]]),
    )


def perceived(
    later: PlantOutput,
    task: TaskSettings | None = None,
    rewards: RewardSettings | None = None,
    steps: int = 3,
    speeds: Sequence[float] = (),
) -> Percept:
    before = previous(steps)._replace(speeds=torch.tensor(speeds).unsqueeze(1).expand(-1, 2))
    return perceive(
        before,
        later,
        settings=RAW,
        task=task or of_task(),
        rewards=rewards or of_reward(),
        guard=None,
        encoders=nominal_encoders(),
    )


def test_velocities_are_differences_of_counts() -> None:
    state = perceived(frame()).state
    x, theta = 100 * nominal_encoders().metres, 10 * nominal_encoders().radians
    torch.testing.assert_close(state[:, 0], torch.zeros(4))
    torch.testing.assert_close(state[:, 1], torch.tensor([x, x / 0.02, theta, theta / 0.02]))


def test_scores_measure_the_speed_of_the_pole_over_20_ms_at_least() -> None:
    """A count of 4096 in 10 ms is 8.8 degrees/s, over the 6 of (6.2); in 20 ms it is 4.4."""
    task = of_task(x_max=0.38)
    moved = frame(cart=0, pole=1)._replace(dt=torch.full((1, 2), 0.01))
    assert perceived(moved, task).score[0].tolist() == pytest.approx([11, 6], abs=1e-5)
    after_rest = perceived(moved, task, speeds=(0.0,))
    assert after_rest.score[0].tolist() == pytest.approx([11, 11], abs=1e-5)
    assert float(after_rest.speeds[0, 1]) == float(after_rest.state[3, 1]) == pytest.approx(math.tau / 40.96)
    assert perceived(moved, task, speeds=(0.15,)).score[0].tolist() == pytest.approx([11, 6], abs=1e-5)
    fine = nominal_encoders()
    assert [speed_periods(each, fine) for each in (0.005, 0.01, 0.019, 0.02, 0.05)] == [4, 2, 2, 1, 1]
    coarse = nominal_encoders()._replace(turn=2400)  # a count is 0.15 degrees, 25 ms at 6 degrees/s
    assert [speed_periods(each, coarse) for each in (0.01, 0.02, 0.025, 0.05)] == [3, 2, 2, 1]


def test_the_newest_of_the_past_comes_first_and_the_oldest_is_forgotten() -> None:
    past = remember(previous(), RAW)
    expected = torch.tensor([51 / MOTOR_SCALE, 0.2, 0.5 / SPEED_SCALE, -2.0 / ANGULAR_SPEED_SCALE])
    torch.testing.assert_close(past[:, 1], expected)


def test_a_first_frame_has_no_velocity_and_no_memory() -> None:
    output = frame()._replace(counts=torch.tensor([[100, 0], [0, 1024]]))
    first = perceive_first(
        output, NO_LENGTH, TRACK_END, settings=RAW, guard=None, encoders=nominal_encoders()
    )
    assert first.state[1].tolist() == first.state[3].tolist() == [0, 0]
    assert first.state[2, 1] == pytest.approx(math.pi / 2)
    assert not first.past.any()
    assert first.observation.shape == (8, 2)
    assert first.score.tolist() == first.score_upright.tolist() == first.step_count.tolist() == [[0, 0]]


@pytest.mark.parametrize(
    ("ended", "task", "steps", "terminated", "truncated"),
    [
        ({}, {}, 3, False, False),
        ({"terminated": True}, {}, 3, True, False),
        ({"truncated": True}, {}, 3, False, True),
        ({"terminated": True, "truncated": True}, {}, 3, True, False),
        ({}, {}, 8, False, True),
        ({"pole": 200}, {"angle_limit": 0.2}, 8, True, False),
    ],
)
def test_an_episode_ends_for_one_kind_of_reason(
    ended: dict[str, Any], task: dict[str, Any], steps: int, terminated: bool, truncated: bool
) -> None:
    """An episode that terminates is not truncated as well; the limit is 9 steps."""
    percept = perceived(frame(**ended), task=of_task(**task), steps=steps)
    assert bool(percept.terminated[0, 1]) == terminated
    assert bool(percept.truncated[0, 1]) == truncated
    assert bool(percept.done[0, 1]) == (terminated or truncated)
    assert percept.step_count.tolist() == [[steps + 1, steps + 1]]


def test_the_reward_has_its_scale_and_the_costs_of_the_track() -> None:
    plain = of_reward(scale=1.0, track_penalty=0.0, position_cost=0.0)
    costly = of_reward(scale=2.0, track_penalty=7.0, position_cost=3.0)
    later = frame(cart=5000, terminated=True)
    value, reward = (perceived(later, rewards=rewards).reward for rewards in (plain, costly))
    nearness = (5000 * nominal_encoders().metres / 0.4) ** 2
    torch.testing.assert_close(reward, 2 * value - torch.tensor([[0.0, 7 + 3 * nearness]]))
