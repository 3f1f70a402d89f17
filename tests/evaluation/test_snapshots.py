"""Snapshots of a driven cart: written by one process, read whole by another."""

import multiprocessing
from contextlib import closing
from itertools import count
from multiprocessing.synchronize import Event

import pytest
import torch
from tensordict import TensorDictBase

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import environment, shipped_settings, simulated_env
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.evaluation.snapshots import COUNTER, Memory, Snapshot, followed, new_memory, read, write
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.workflows.config import TrainConfig, load_settings

ENOUGH = 200  # different snapshots


def numbered(number: int) -> Snapshot:
    """A snapshot whose fields all say which one it is."""
    return Snapshot(*[number] * 6, *[float(number)] * 7)


def full_left(current: TensorDictBase) -> TensorDictBase:
    return current.set("action", torch.zeros(1, dtype=torch.int64))


def write_until(enough: Event, memory: Memory) -> None:
    for number in count(1):
        write(memory, number, numbered(number))
        if enough.is_set():
            return


def test_the_newest_snapshot_is_read() -> None:
    memory = new_memory()
    for number in (1, 2):
        write(memory, number, numbered(number))
    assert read(memory) == (2, numbered(2))


def test_more_lost_frames_than_a_cart_can_count_are_published() -> None:
    memory, many = new_memory(), numbered(1)._replace(lost_frames=2**32 + 5, late_ticks=2**33)
    write(memory, 1, many)
    assert read(memory) == (1, many)


def test_a_snapshot_that_is_being_written_is_not_read() -> None:
    memory = new_memory()
    write(memory, 1, numbered(1))
    COUNTER.pack_into(memory, 0, 3)
    assert read(memory) is None


def test_another_process_never_reads_parts_of_two_snapshots() -> None:
    memory = new_memory()
    context = multiprocessing.get_context("fork")  # it imports nothing again
    enough = context.Event()
    process = context.Process(target=write_until, args=(enough, memory), daemon=True)
    process.start()
    seen = set()
    while process.is_alive() and len(seen) < ENOUGH:
        if (found := read(memory)) is not None:
            assert found == (found[0], numbered(found[0]))
            seen.add(found[0])
    enough.set()
    process.join()
    newest, last = read(memory)
    assert newest >= max(seen)
    assert last == numbered(newest)
    assert len(seen) == ENOUGH


def test_a_driven_cart_publishes_what_the_episode_holds() -> None:
    settings = shipped_settings({"task.time_limit": 40})
    plant = emulated_plant(EmulatorSettings(physics_step=1e-3), settings.control_period)
    with closing(environment(settings, plant)) as env:
        memory = new_memory()
        followed(env, memory)
        *_, episode = run_episodes(env, full_left, 2)
        number, snapshot = read(memory)
    assert number == 2 * 40  # one for each period
    assert (snapshot.episode, snapshot.step) == (2, 39)
    assert snapshot.motor == episode.motor[-1]
    assert (snapshot.x, snapshot.theta) == pytest.approx((episode.x[-2], episode.theta[-2]), abs=1e-6)
    assert snapshot.score == pytest.approx(episode.score[:-1].sum(), rel=1e-5)
    assert snapshot.late_ticks == plant.cart.statistics.late_ticks
    assert snapshot.track_half_length == pytest.approx(0.38, abs=0.01)
    assert snapshot.pole == 0.0  # a cart on a port does not know it


def test_a_simulated_cart_publishes_the_pole_that_it_drew() -> None:
    settings = load_settings(TrainConfig, {"pole": "range", "task.time_limit": 3})
    with closing(simulated_env(settings, settings.plant, 1, settings.task.start, seed=1)) as env:
        memory = new_memory()
        followed(env, memory)
        (episode,) = run_episodes(env, full_left, 1)
        _, snapshot = read(memory)
    assert snapshot.pole == pytest.approx(episode.pole_length)
    assert snapshot.pole != pytest.approx(settings.pole.nominal.length)
