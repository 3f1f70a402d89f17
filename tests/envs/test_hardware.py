"""The hardware transform over simulated carts: observations, memory, endings, rewards, resets."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.features import (
    MOTOR_SCALE,
    Measured,
    ObservationKind,
    observe,
)
from cartpole_rl.tasks.rewards import Reward
from cartpole_rl.tasks.settings import Start, StartSettings

MakePlant = Callable[..., SimulatedPlant]
MakeEnvironment = Callable[..., CartPoleEnv]
MOTORS = (-250, -100, 0, 100, 250)
ANYWHERE = StartSettings(
    angle=Start.ANY, position_spread=0.2, angle_spread=0, speed_spread=0.2, angular_speed_spread=1.0
)
UPRIGHT = StartSettings(
    angle=Start.UPRIGHT, position_spread=0, angle_spread=0.02, speed_spread=0, angular_speed_spread=0
)


def actions(count: int, carts: int) -> Tensor:
    return torch.randint(len(MOTORS), (count, carts), generator=torch.Generator().manual_seed(0))


def course(env: CartPoleEnv, chosen: Tensor) -> TensorDict:
    """Transitions [T, N] under `chosen` action indices [T, N], resetting what ends."""
    present, taken = env.reset(), []
    for action in chosen:
        transition, present = env.step_and_maybe_reset(present.set("action", action))
        taken.append(transition)
    return torch.stack(taken)


@pytest.mark.parametrize("kind", ObservationKind)
@pytest.mark.parametrize(
    ("pole_length", "past"), [(True, (0, 0, 0)), (False, (2, 1, 0)), (True, (3, 0, 2)), (False, (0, 1, 1))]
)
def test_specs(
    make_plant: MakePlant,
    make_environment: MakeEnvironment,
    kind: str,
    pole_length: bool,
    past: tuple[int, int, int],
) -> None:
    observation = {
        "kind": kind,
        "pole_length": pole_length,
        "past_motors": past[0],
        "past_velocities": past[1],
        "past_positions": past[2],
    }
    env = make_environment(make_plant(3, start=ANYWHERE), **observation)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (3, env.hardware.observation_settings.size)


class TestObservation:
    def test_measured_state_is_near_the_true_one(
        self, make_plant: MakePlant, make_environment: MakeEnvironment
    ) -> None:
        plant = make_plant(8, start=ANYWHERE)
        measured = course(make_environment(plant, MOTORS), actions(10, 8))[-1]["next", "state"]
        true = torch.stack(plant.true_state, 1)
        error = measured - true
        error[:, 2] = torch.remainder(error[:, 2] + 1, 2 * math.pi) - 1
        assert (error.abs() < torch.tensor([2e-5, 0.2, 1e-3, 2.0])).all()

    @pytest.mark.parametrize("pole_length", [True, False])
    def test_frames_pair_positions_with_the_motor_value_before_them(
        self, make_plant: MakePlant, make_environment: MakeEnvironment, pole_length: bool
    ) -> None:
        env = make_environment(
            make_plant(2, start=ANYWHERE),
            MOTORS,
            kind="positions",
            past_motors=4,
            past_positions=2,
            pole_length=pole_length,
        )
        chosen = actions(6, 2)
        taken = course(env, chosen)
        seen = taken[4]["next", "observation"][:, env.hardware.observation_settings.frames]
        for frame, time in enumerate((2, 3, 4)):
            following = Measured(*taken[time]["next", "state"].unbind(1))
            position = torch.stack(observe(following, ObservationKind.POSITIONS), 1)
            motor = torch.tensor(MOTORS)[chosen[time]].unsqueeze(1) / MOTOR_SCALE
            torch.testing.assert_close(seen[:, frame], torch.cat((position, motor), 1))

    def test_actions_are_indices_of_motor_values(
        self, make_plant: MakePlant, make_environment: MakeEnvironment
    ) -> None:
        taken = course(make_environment(make_plant(5), MOTORS), torch.arange(5).unsqueeze(0))
        assert taken["next", "motor_applied"].flatten().tolist() == list(MOTORS)


class TestEndings:
    def run(self, env: CartPoleEnv, action: int) -> list[TensorDict]:
        """Frames from a reset to the first end."""
        present, frames = env.reset(), []
        for _ in range(1000):
            following = env.step(present.set("action", torch.tensor([action])))["next"]
            frames.append(following)
            if following["done"]:
                return frames
            present = following.exclude("reward")
        raise AssertionError("no end")

    def test_twelve_degrees_terminate_the_balance(
        self, make_plant: MakePlant, make_environment: MakeEnvironment
    ) -> None:
        limit = math.radians(12)
        reward = {"kind": "constant", "scale": 1.0, "track_penalty": 7.0}
        env = make_environment(make_plant(start=UPRIGHT), angle_limit=limit, reward=reward)
        frames = self.run(env, action=1)
        assert all(frame["reward"].item() == 1 for frame in frames)  # the penalty is the track's alone
        angles = [abs(frame["state"][0, 2].item()) for frame in frames]
        assert angles[-1] > limit
        assert max(angles[:-1]) <= limit
        assert frames[-1]["terminated"].item()
        assert not frames[-1]["truncated"].item()

    def test_the_end_of_the_track_terminates_with_the_penalty(
        self, make_plant: MakePlant, make_environment: MakeEnvironment
    ) -> None:
        frames = self.run(
            make_environment(make_plant(), reward={"track_penalty": 7.0, "scale": 0.5}), action=2
        )
        assert frames[-1]["terminated"].item()
        assert not frames[-1]["truncated"].item()
        assert abs(frames[-1]["state"][0, 0].item()) > 0.38
        assert frames[-1]["reward"].item() == pytest.approx(-7.0, abs=0.01)
        assert all(frame["reward"].item() >= 0 for frame in frames[:-1])


@pytest.mark.parametrize("kind", Reward)
def test_rewards_and_scores_are_of_the_measured_state(
    make_plant: MakePlant, make_environment: MakeEnvironment, kind: Reward
) -> None:
    reward: dict[str, Any] = {"kind": kind, "scale": 0.3, "track_penalty": 0.0, "position_cost": 0.0}
    env = make_environment(make_plant(32, start=ANYWHERE), MOTORS, reward=reward)
    following = course(env, actions(10, 32))["next"].flatten()
    for key, law, scale in (
        ("reward", kind, 0.3),
        ("score", Reward.SCORE, 1.0),
        ("score_upright", Reward.POSITION, 1.0),
    ):
        expected = scale * law.formula(Measured(*following["state"].unbind(1)), 0.38)
        torch.testing.assert_close(following[key].squeeze(-1), expected)


class TestAutoReset:
    LIMIT = 7

    @pytest.fixture
    def env(self, make_plant: MakePlant, make_environment: MakeEnvironment) -> CartPoleEnv:
        ranges = {"cart_mass": Range(relative=(-0.2, 0.2)), "angle_noise": Range(absolute=(0.001, 0.01))}
        plant = make_plant(6, ranges=ranges, start=ANYWHERE)
        return make_environment(plant, MOTORS, time_limit=self.LIMIT)

    def test_resets_only_the_rows_that_ended(self, env: CartPoleEnv) -> None:
        """One cart is thrown off the track; the others go on, with their parameters and their memory."""
        present = env.reset()
        for action in actions(3, 6):
            _, present = env.step_and_maybe_reset(present.set("action", action))
        state = torch.stack(env.plant.true_state)
        state[0, 2] = 5.0
        env.plant.place(State(*state))
        masses = env.plant.parameters.cart_mass.clone()

        transition, present = env.step_and_maybe_reset(present.set("action", actions(1, 6)[0]))

        others = [0, 1, 3, 4, 5]
        assert transition["next", "done"].flatten().tolist() == [row == 2 for row in range(6)]
        assert (env.plant.parameters.cart_mass != masses).tolist() == [row == 2 for row in range(6)]
        assert present["step_count"].flatten().tolist() == [4, 4, 0, 4, 4, 4]
        assert not present["done"].any()
        for key in ("observation", "state", "past", "counts"):
            assert (present[key][others] == transition["next", key][others]).all()
            assert (present[key][2] != transition["next", key][2]).any()
