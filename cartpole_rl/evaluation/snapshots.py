"""Snapshots of a driven cart in memory shared with another process, which shows them.

The driving process writes one snapshot a period, right after it has sent a motor value: it then waits for the
cart in any case. Nothing is locked. A counter that is odd during a write lets the reader discard torn data.
"""

import multiprocessing
import os
import struct
import time
from collections.abc import Iterable
from ctypes import Array, c_char
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from cartpole_rl.envs.cart_pole_env import CartPoleEnv

COUNTER = struct.Struct("<Q")
FIELDS = struct.Struct("<2I 2i 2Q 7d")  # a jump of the cart's tick can add 2^32 lost frames at once
DRIVER = struct.Struct("<I")  # behind the fields: the id of the process that drives, 0 before it does
SIZE = COUNTER.size + FIELDS.size + DRIVER.size
ATTEMPTS = 10  # to read while the writer writes

Memory = Array[c_char]


class Snapshot(NamedTuple):
    """A cart at one moment of an episode."""

    episode: int  # from 1
    step: int  # control periods of the episode
    motor: int  # motor value sent, -255 to 255
    guard: int  # direction of the track guard's motor value, 0 if the agent's was sent
    late_ticks: int  # of all episodes
    lost_frames: int
    x: float  # m
    x_dot: float  # m/s
    theta: float  # rad, 0 upright
    theta_dot: float  # rad/s
    score: float  # sum of equation (6.2) so far
    track_half_length: float  # m
    pole: float  # its length, m; 0 on a cart that does not know it


def new_memory() -> Memory:
    """Return memory for a snapshot, which a new process of `multiprocessing` can be given."""
    return multiprocessing.RawArray(c_char, SIZE)


def write(memory: Memory, number: int, snapshot: Snapshot) -> None:
    """Write the snapshot `number`, which counts up from 1."""
    COUNTER.pack_into(memory, 0, 2 * number - 1)
    FIELDS.pack_into(memory, COUNTER.size, *snapshot)
    COUNTER.pack_into(memory, 0, 2 * number)


def read(memory: Memory) -> tuple[int, Snapshot] | None:
    """Return the number and the content of the newest snapshot; None before the first one."""
    for _ in range(ATTEMPTS):
        (before,) = COUNTER.unpack_from(memory, 0)
        snapshot = Snapshot(*FIELDS.unpack_from(memory, COUNTER.size))
        (after,) = COUNTER.unpack_from(memory, 0)
        if before == after and before % 2 == 0:
            return (before // 2, snapshot) if before else None
    return None


def driver(memory: Memory) -> int:
    """Return the id of the process that drives the cart; 0 before it does."""
    (process,) = DRIVER.unpack_from(memory, SIZE - DRIVER.size)
    return int(process)


def followed(env: "CartPoleEnv", memory: Memory | None, row: int = 0) -> "CartPoleEnv":
    """Return `env`, whose cart is published in `memory` from now on, if there is one.

    Of many simulated carts it is that of `row`, and they are driven at the pace of a real one.
    """
    if memory is None:
        return env
    DRIVER.pack_into(memory, SIZE - DRIVER.size, os.getpid())
    if env.plant.drives_one_cart:
        env.plant.on_command = Publisher(env, memory).on_command
    else:
        env.on_step = Publisher(env, memory, row).on_step
    return env


class Publisher:
    """Writes snapshots of the cart in `row` to `memory`, one a period."""

    def __init__(self, env: "CartPoleEnv", memory: Memory, row: int = 0) -> None:
        self._env, self._memory, self._row = env, memory, row
        self._written = self._episode = 0
        self._score = self._track_half_length = self._pole = 0.0
        self._ended = False

    def on_command(self, motor: int) -> None:
        """Write the state of one cart that a motor value was chosen on, once that has been sent."""
        percept = self._env.one_cart.percept
        (step,), (guard,), (score,) = percept.step_count, percept.guard, percept.score
        self._publish(step, motor, guard, score, percept.state)

    def on_step(self, stepped: "TensorDictBase") -> None:
        """Write the state of one of many carts, and the motor value chosen on it; wait for the time it takes.

        Once the first episode of that cart has ended, nothing is written until the next reset, and nothing
        waits.
        """
        cart, period = stepped[self._row], self._env.plant.period
        step = int(cart["step_count"])
        if step == 0:
            self._due, self._ended = time.monotonic(), False
            self._pole = float(self._env.plant.pole_length[self._row])
        if self._ended:
            return
        motor = int(self._env.hardware.sent_motors(cart["action"].reshape(1), cart["guard"]))
        self._publish(step, motor, int(cart["guard"]), float(cart["score"]), cart["state"].tolist())
        self._ended = bool(cart["next", "done"])
        self._due = max(self._due + period, time.monotonic() - period)
        time.sleep(max(0.0, self._due - time.monotonic()))

    def _publish(self, step: int, motor: int, guard: int, score: float, state: Iterable[float]) -> None:
        plant, statistics = self._env.plant, self._env.plant.statistics
        if step == 0:
            self._episode += 1
            self._score, self._track_half_length = 0.0, float(plant.track_half_length[self._row])
        self._score += score
        self._written += 1
        present = self._episode, step, motor, guard, statistics.late_ticks, statistics.lost_frames
        snapshot = (*present, *state, self._score, self._track_half_length, self._pole)
        write(self._memory, self._written, Snapshot._make(snapshot))
