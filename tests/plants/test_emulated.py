"""The serial plant on the emulated cart, as TorchRL drives it."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import LinkError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant

TURN = 4096

fast = partial(EmulatorSettings, physics_step=1e-3)


@pytest.fixture(scope="module")
def plant() -> Iterator[SerialPlant]:
    with contextlib.closing(emulated_plant(fast())) as plant:
        yield plant


def push(plant: SerialPlant, motor: int) -> TensorDict:
    return plant.step(TensorDict({"motor": torch.full((1, 1), motor)}, [1]))["next"]


def test_specs(plant: SerialPlant) -> None:
    check_env_specs(plant)


def test_an_episode_begins_in_the_middle_with_a_hanging_pole(plant: SerialPlant) -> None:
    cart, pole = plant.reset()["counts"][0].tolist()
    assert abs(cart) < 100
    assert abs(pole % TURN - TURN // 2) < 10


def test_a_rollout_is_as_long_as_asked(plant: SerialPlant) -> None:
    rollout = plant.rollout(
        50, TensorDictModule(lambda counts: torch.zeros_like(counts[:, :1]), ["counts"], ["motor"])
    )
    assert rollout.shape == (1, 50)
    assert rollout["next", "dt"].flatten().tolist() == pytest.approx([0.02] * 50)


@pytest.mark.parametrize("side", [1, -1])
def test_the_end_of_the_track_ends_the_episode_and_the_next_one_begins(plant: SerialPlant, side: int) -> None:
    plant.reset()
    for _ in range(200):
        frame = push(plant, side * 250)
        if frame["done"]:
            break
    assert frame["terminated"]
    assert not frame["truncated"]
    assert plant.ended_by == "track"
    assert side * frame["counts"][0, 0] >= plant.cart.information.soft_limit_counts
    assert side * plant.cart.poll_state().motor_applied <= 0  # the firmware brakes
    frame = plant.reset()
    assert not frame["done"]
    assert abs(frame["counts"][0, 0]) < 100


def test_an_episode_can_be_had_again() -> None:
    def episode() -> list[list[int]]:
        with contextlib.closing(emulated_plant(fast(seed=3))) as plant:
            plant.reset()
            return [push(plant, 200 if step % 24 < 12 else -200)["counts"][0].tolist() for step in range(60)]

    assert episode() == episode()


def test_an_upright_start() -> None:
    said: list[str] = []
    settings = fast(start="upright")
    with contextlib.closing(emulated_plant(settings, prompt=said.append)) as plant:
        for episode in (1, 2):
            pole = plant.reset()["counts"][0, 1].item()
            assert abs((pole + TURN // 2) % TURN - TURN // 2) < 60
            assert len(said) == episode
            falling = [push(plant, 0)["counts"][0, 1].item() for _ in range(60)]
            assert abs(falling[-1] - pole) > 300


def test_a_killed_emulator_truncates_and_the_next_reset_says_so() -> None:
    emulated = EmulatedCart(fast())
    with contextlib.closing(SerialPlant(emulated.settings, owned=emulated)) as plant:
        plant.reset()
        before = push(plant, 100)
        os.kill(emulated.pid, signal.SIGKILL)
        time.sleep(0.2)
        frame = push(plant, 100)
        assert frame["truncated"]
        assert not frame["terminated"]
        assert frame["counts"].equal(before["counts"])
        assert plant.ended_by == "link"
        assert isinstance(plant.last_error, LinkError)
        with pytest.raises(LinkError, match=r"link to the cart was lost .*exit code -9"):
            plant.reset()


def test_a_bad_cable_still_gives_whole_episodes() -> None:
    with contextlib.closing(emulated_plant(fast(frame_loss=0.05, frame_corruption=0.05))) as plant:
        plant.reset()
        plant.cart.statistics.clear()
        dts = [round(push(plant, 0)["dt"].item() / 0.02) for _ in range(200)]
        assert plant.ended_by == ""
        assert min(dts) == 1
        summary = plant.cart.statistics.summary()
        assert sum(dts) == summary.frames_received + summary.lost_frames
        assert max(dts) > 1


def test_pole_length_is_that_of_the_emulated_pole(plant: SerialPlant) -> None:
    assert plant.pole_length.tolist() == pytest.approx([2 * EmulatorSettings().pole_com])


def test_closing_ends_the_process() -> None:
    emulated = EmulatedCart(fast())
    plant = SerialPlant(emulated.settings, owned=emulated)
    plant.close()
    with pytest.raises(ProcessLookupError):
        os.kill(emulated.pid, 0)


def test_a_restart_of_the_cart_ends_the_episode_with_what_came_last() -> None:
    with contextlib.closing(emulated_plant(fast(reset_at=45.0))) as plant:
        plant.reset()
        last = None
        for step in range(2000):
            frame = push(plant, 100 if step % 20 < 10 else -100)
            if frame["done"]:
                break
            last = frame
        assert plant.ended_by == "link"
        assert last is not None
        assert frame["truncated"]
        assert frame["counts"].tolist() == last["counts"].tolist()
        assert frame["dt"].item() == pytest.approx(0.02)
