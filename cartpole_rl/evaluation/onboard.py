"""Episodes that the policy on a cart's board drives, while this computer only listens.

In each period this computer sends HELLO, which keeps the cart's watchdog quiet, and reads the state.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import ObservationSettings
from cartpole_rl.evaluation.episodes import (
    Policy,
    chosen_action,
    ending_of,
    one_episode,
    prepared,
    with_periods,
)
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.specs import Numbers, PlantOutput
from cartpole_rl.scheduling import no_garbage_collection
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.wire.messages import Flags

LATE_PERIODS = 1.5
STOPPING = (Ending.TRACK, Ending.FAULT, Ending.LINK)  # the motor is at 0 in the last state


def run_onboard_episodes(env: CartPoleEnv, policy: Policy, episodes: int) -> Iterator[Episode]:
    """Yield episodes of the cart's board, with the motor values that `policy` would have chosen here.

    Raises RefusedError if the board has no policy, FaultError if nothing was measured, and the errors of the
    plant's reset.
    """
    policy = prepared(env, policy)
    yield from with_periods(run_onboard(env, policy) for _ in range(episodes))


@torch.no_grad()
def run_onboard(env: CartPoleEnv, policy: Policy) -> Episode:
    """Return an episode of the cart's board. `motor` is what the cart reports at the end of each period."""
    plant, cart, steps, done = env.plant, env.one_cart, [], False
    assert isinstance(plant, SerialPlant)
    with no_garbage_collection(), on_board(plant):
        first = cart.reset()
        frames, stopped = [cart.frame], [False]
        try:
            while not done:
                frame = plant.listen_one()
                step = cart.advance(frame.motor_applied[0], frame)
                frames.append(frame)
                stopped.append(bool(plant.cart.flags & (Flags.WATCHDOG | Flags.SOFT_LIMIT)))
                steps.append(step)
                (done,) = step.done
        finally:
            plant.halt()
    percepts = [first, *steps[:-1]]
    actions = [chosen_action(policy, percept.observation) for percept in percepts]
    chosen = np.array([cart.motor(action) for action in actions])
    expected = np.array([cart.guarded_motor(*pair) for pair in zip(actions, percepts, strict=True)])
    motor = np.array([frame.motor_applied[0] for frame in frames[1:]])
    ending = ending_of(env, 0, steps[-1].truncated[0], steps[-1].state[2])
    episode = one_episode(env, first, steps, frames, motor, expected != chosen, ending)
    gaps = np.array(stopped) | late(frames, plant.cart.information.period_us * 1e-6)
    compared = comparable(gaps[1:], memory(env.hardware.observation_settings), ending)
    return replace(episode, expected=expected[: episode.steps], compared=compared[: episode.steps])


def late(frames: Sequence[PlantOutput[Numbers]], period: float) -> NDArray[np.bool_]:
    """Return [T+1] which frames came more than 1.5 periods after the one before: states were missed."""
    return np.array([frame.dt[0] for frame in frames]) > LATE_PERIODS * period


def memory(observation: ObservationSettings) -> int:
    """Return how many past periods an agent observes."""
    return max(observation.past_motors, observation.past_velocities, observation.past_positions)


def comparable(gaps: NDArray[np.bool_], memory: int, ending: str) -> NDArray[np.bool_]:
    """Return [T] in which periods board and computer chose from the same observation.

    `gaps` [T]: before the state at the end of the period, a state was missed, or the watchdog or a limit
    held the motor.
    The board then observes other velocities, for `memory` periods more another past. The last state before an
    ending that stops the motor does not report the policy's value.
    """
    compared = np.ones(len(gaps), bool)
    for period in np.flatnonzero(gaps):
        compared[period : period + memory + 3] = False
    if ending in STOPPING:
        compared[-1] = False
    return compared


@contextmanager
def on_board(plant: SerialPlant) -> Iterator[None]:
    """Let the policy on the board drive within the `with`."""
    plant.on_board = True
    try:
        yield
    finally:
        plant.on_board = False
