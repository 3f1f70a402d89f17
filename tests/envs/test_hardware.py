"""The hardware transform: observations, memory, rewards, resets; its specs are those of any plant."""

import math
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
import torch
from courses import ANYWHERE
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.dynamics import State
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.features import MOTOR_SCALE, Measured, ObservationKind, observe
from cartpole_rl.tasks.rewards import Reward

Simulated = Callable[..., CartPoleEnv]
MOTORS = (-250, -100, 0, 100, 250)


def actions(count: int, carts: int) -> Tensor:
    return torch.randint(len(MOTORS), (count, carts), generator=torch.Generator().manual_seed(0))


def course(env: CartPoleEnv, chosen: Tensor) -> TensorDict:
    """Transitions [T, N] under `chosen` action indices [T, N], resetting what ends."""
    present, taken = env.reset(), []
    for action in chosen:
        transition, present = env.step_and_maybe_reset(present.set("action", action))
        taken.append(transition)
    return torch.stack(taken)


@pytest.mark.parametrize(
    ("kind", "pole_length", "motors", "velocities", "positions"),
    [
        (kind, *others)
        for kind, others in zip(
            ObservationKind, ((True, 0, 0, 0), (False, 2, 1, 0), (True, 3, 0, 2)), strict=True
        )
    ],
)
def test_specs(
    simulated: Simulated, kind: str, pole_length: bool, motors: int, velocities: int, positions: int
) -> None:
    past = {"past_motors": motors, "past_velocities": velocities, "past_positions": positions}
    env = simulated(3, {"start": ANYWHERE}, kind=kind, pole_length=pole_length, **past)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (3, env.hardware.observation_settings.size)


def test_specs_over_a_serial_cart_hold_and_are_those_over_a_simulated_one(
    simulated: Simulated, make_environment: Callable[..., CartPoleEnv]
) -> None:
    observation = {"pole_length": True, "past_motors": 2, "past_velocities": 2}
    with closing(emulated_plant(EmulatorSettings(physics_step=1e-3))) as plant:
        over_serial, over_simulated = make_environment(plant, **observation), simulated(**observation)
        for one, other in ((plant, over_simulated.plant), (over_serial, over_simulated)):
            assert (one.input_spec, one.output_spec) == (other.input_spec, other.output_spec)
        check_env_specs(over_simulated)
        check_env_specs(over_serial)


def test_no_environment_is_moved_to_another_device(simulated: Simulated) -> None:
    """Its specs would move, its carts would not."""
    env = simulated()
    assert env.to("cpu").device == env.device
    with pytest.raises(ConfigError, match="the plant was made on cpu; make it on meta in place of moving it"):
        env.to("meta")


def test_measured_state_is_near_the_true_one(simulated: Simulated) -> None:
    env = simulated(8, {"start": ANYWHERE}, motors=MOTORS)
    measured = course(env, actions(10, 8))[-1]["next", "state"]
    error = measured - torch.stack(env.plant.true_state, 1)
    error[:, 2] = torch.remainder(error[:, 2] + 1, 2 * math.pi) - 1
    assert (error.abs() < torch.tensor([2e-5, 0.2, 1e-3, 2.0])).all()


@pytest.mark.parametrize("pole_length", [True, False])
def test_frames_pair_positions_with_the_motor_value_before_them(
    simulated: Simulated, pole_length: bool
) -> None:
    observation = {"kind": "positions", "past_motors": 4, "past_positions": 2, "pole_length": pole_length}
    env, chosen = simulated(2, {"start": ANYWHERE}, motors=MOTORS, **observation), actions(6, 2)
    taken = course(env, chosen)
    seen = taken[4]["next", "observation"][:, env.hardware.observation_settings.frames]
    for frame, time in enumerate((2, 3, 4)):
        following = Measured(*taken[time]["next", "state"].unbind(1))
        position = torch.stack(observe(following, ObservationKind.POSITIONS), 1)
        motor = torch.tensor(MOTORS)[chosen[time]].unsqueeze(1) / MOTOR_SCALE
        torch.testing.assert_close(seen[:, frame], torch.cat((position, motor), 1))


def test_actions_are_indices_of_motor_values(simulated: Simulated) -> None:
    taken = course(simulated(5, motors=MOTORS), torch.arange(5).unsqueeze(0))
    assert taken["next", "motor_applied"].flatten().tolist() == list(MOTORS)


@pytest.mark.parametrize("kind", Reward)
def test_rewards_and_scores_are_of_the_measured_state(simulated: Simulated, kind: Reward) -> None:
    reward: dict[str, Any] = {"kind": kind, "scale": 0.3, "track_penalty": 0.0, "position_cost": 0.0}
    env = simulated(32, {"start": ANYWHERE}, motors=MOTORS, reward=reward)
    following = course(env, actions(10, 32))["next"].flatten()
    for key, law, scale in (
        ("reward", kind, 0.3),
        ("score", Reward.SCORE, 1.0),
        ("score_upright", Reward.POSITION, 1.0),
    ):
        expected = scale * law.formula(Measured(*following["state"].unbind(1)), 0.38)
        torch.testing.assert_close(following[key].squeeze(-1), expected)


def test_a_step_resets_only_the_rows_that_ended(simulated: Simulated) -> None:
    """One cart is thrown off the track; the others go on, with their parameters and their memory."""
    ranges = {"cart_mass": Range(relative=(-0.2, 0.2)), "angle_noise": Range(absolute=(0.001, 0.01))}
    env = simulated(6, {"ranges": ranges, "start": ANYWHERE}, motors=MOTORS, time_limit=7)
    present = env.reset()
    for action in actions(3, 6):
        _, present = env.step_and_maybe_reset(present.set("action", action))
    state = torch.stack(env.plant.true_state)
    state[0, 2] = 5.0
    env.plant.place(State(*state))
    masses = env.plant.parameters.cart_mass.clone()

    transition, present = env.step_and_maybe_reset(present.set("action", actions(1, 6)[0]))

    others, ended = [0, 1, 3, 4, 5], [row == 2 for row in range(6)]
    assert transition["next", "done"].flatten().tolist() == ended
    assert (env.plant.parameters.cart_mass != masses).tolist() == ended
    assert present["step_count"].flatten().tolist() == [4, 4, 0, 4, 4, 4]
    assert not present["done"].any()
    for key in ("observation", "state", "past", "counts"):
        assert (present[key][others] == transition["next", key][others]).all()
        assert (present[key][2] != transition["next", key][2]).any()
