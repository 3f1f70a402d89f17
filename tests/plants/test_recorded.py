"""A recording played back means what the cart meant when it was recorded."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.simulated import SimulatedPlant

MOTORS = (-200, 0, 200)


def test_played_back_frames_are_understood_as_the_first_time(
    make_plant: Callable[..., SimulatedPlant], make_environment: Callable[..., CartPoleEnv]
) -> None:
    """To the end: this cart runs off its track."""
    env, seen = make_environment(make_plant(1, cart={"track_half_length": 0.05}), MOTORS), []

    def policy(present: TensorDictBase) -> TensorDictBase:
        seen.append(present.clone())
        return present.set("action", torch.tensor([2]))

    (episode,) = run_batch(env, policy)
    assert episode.ended_by == "track"
    again = make_environment(RecordedPlant(episode, None), MOTORS)
    present = again.reset()
    for row, motor in enumerate(episode.motor.tolist()):
        torch.testing.assert_close(present["observation"], seen[row]["observation"])
        present["action"] = torch.tensor([MOTORS.index(motor)])
        following = again.step(present)["next"]
        torch.testing.assert_close(following["reward"].item(), float(episode.reward[row]))
        torch.testing.assert_close(following["score"].item(), float(episode.score[row]))
        present = following.exclude("reward")
    assert following["terminated"].item()


def test_it_keeps_the_contract(
    make_plant: Callable[..., SimulatedPlant], make_environment: Callable[..., CartPoleEnv]
) -> None:
    env = make_environment(make_plant(1), MOTORS, time_limit=20)
    (episode,) = run_batch(env, lambda present: present.set("action", torch.tensor([0])))
    check_env_specs(RecordedPlant(episode, None))
    check_env_specs(make_environment(RecordedPlant(episode, None), MOTORS))
