"""Whole episodes of a policy on any plant.

N carts run N episodes at once, each from the common reset to its first end, so short episodes are not
over-represented. A policy on a cart's board may drive instead, while this computer only listens: in each
period it sends HELLO, which keeps the cart's watchdog quiet, and reads the state.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain, islice

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import QValueActor

from cartpole_rl.envs.cart_pole_env import CartPoleEnv, OneCart
from cartpole_rl.envs.hardware import finite_actions
from cartpole_rl.envs.perception import Percept
from cartpole_rl.errors import ConfigError, FaultError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.plants.measured import measured_part
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput, tensordict_of
from cartpole_rl.scheduling import no_garbage_collection
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE
from cartpole_rl.tasks.settings import NO_ACTION
from cartpole_rl.wire.messages import Flags

# reads `observation` [N, K]; writes `action` [N] and, if it has them, the `action_value` [N, A]
Policy = Callable[[TensorDictBase], TensorDictBase]
_FROM_NEXT = ("score", "score_upright", "reward", "done")
STANDS = 2.0  # s within 5 degrees of upright, after which the pole is knocked
LATE_PERIODS = 1.5  # between two states of a board that drives: one was missed
STOPPING = (Ending.TRACK, Ending.FAULT, Ending.LINK)  # the motor is at 0 in the last state


class Knocks:
    """A hand tips each pole over once it stands, as in the thesis's figure 6.10b.

    One knock per episode for each simulated cart: `speed` rad/s more, to the right and left in turn.

    Call it in each period, before the step.
    """

    def __init__(self, plant: Plant, speed: float) -> None:
        self._plant = plant
        self._speeds = speed * torch.tensor([1.0, -1.0]).repeat(1 + plant.carts // 2)[: plant.carts]
        self._patience = round(STANDS / plant.period)
        self.reset()

    def reset(self) -> None:
        """Begin an episode on all carts."""
        self._standing = torch.zeros(self._plant.carts, dtype=torch.int64)  # periods
        self._knocked = torch.zeros(self._plant.carts, dtype=torch.bool)

    def __call__(self) -> None:
        """Knock the poles that have stood for STANDS and were not knocked in this episode."""
        state = self._plant.true_state
        upright = state.theta.cos() > math.cos(UPRIGHT_ANGLE)
        self._standing = torch.where(upright, self._standing + 1, 0)
        due = (self._standing >= self._patience) & ~self._knocked
        if due.any():
            self._plant.place(state._replace(theta_dot=state.theta_dot + self._speeds * due))
            self._knocked |= due


def run_episodes(
    env: CartPoleEnv, policy: Policy, episodes: int, knocks: Knocks | None = None
) -> Iterator[Episode]:
    """Yield `episodes` episodes, on simulated carts with `knocks`. Raises the errors of the plant's reset.

    Raises FaultError if nothing was measured in any of them; such an episode is not yielded.
    """
    policy = prepared(env, policy)
    warm_up(env, policy)
    batches = (run_batch(env, policy, knocks) for _ in range(math.ceil(episodes / env.plant.carts)))
    yield from with_periods(islice(chain.from_iterable(batches), episodes))


def with_periods(episodes: Iterable[Episode]) -> Iterator[Episode]:
    """Yield the episodes in which a control period was measured. Raises FaultError if there is none."""
    nothing = True
    for episode in episodes:
        if episode.steps:
            nothing = False
            yield episode
    if nothing:
        raise FaultError("no control period was measured: check the cables of the encoders")


def prepared(env: CartPoleEnv, policy: Policy) -> Policy:
    """Return the policy to drive with: a Q-network that drives one cart becomes a DrivingPolicy."""
    if env.plant.drives_one_cart and isinstance(policy, QValueActor):
        return DrivingPolicy(policy)
    return policy


@torch.no_grad()
def warm_up(env: CartPoleEnv, policy: Policy) -> None:
    """Compute a period: compilation and lazy loading must not delay the first ticks.

    A serial cart repeats it before each episode, before it is armed: what is not in the processor's caches
    makes the first tick the slowest.
    """
    if env.plant.drives_one_cart:
        rehearse(env.one_cart, policy)
        env.plant.before_start = partial(rehearse, env.one_cart, policy)
        return
    blank = env.fake_tensordict()
    choose(policy, blank)
    env.hardware.perceive(blank, env.hardware.command(blank), blank["next"])


def rehearse(cart: OneCart, policy: Policy) -> None:
    """Perceive a period that changes nothing, and choose an action on it."""
    chosen_action(policy, cart.rehearse().observation)


def choose(policy: Policy, current: TensorDictBase) -> Tensor:
    """Return the policy's actions [N]; NO_ACTION if the observation or an action value is not finite.

    Raises ConfigError for actions that are no integers.
    """
    observed = current.select("observation")
    numbers = observed.get("observation")
    chosen = policy(observed)
    action = chosen.get("action")
    if action.dtype not in (torch.int32, torch.int64):
        raise ConfigError(
            f"the policy gives actions of {action.dtype}: give the index of a motor value, int64"
        )
    return finite_actions(action, numbers, chosen.get("action_value", None))


def run_batch(env: CartPoleEnv, policy: Policy, knocks: Knocks | None = None) -> list[Episode]:
    """Return one episode of each cart, all from one reset."""
    if env.plant.drives_one_cart and knocks is None:
        return [run_one(env, policy)]
    return run_many(env, policy, knocks)


@torch.no_grad()
def run_one(env: CartPoleEnv, policy: Policy) -> Episode:
    """Return an episode of a plant of one cart, on plain numbers."""
    cart, steps, motors, guarded, done = env.one_cart, [], [], [], False
    with no_garbage_collection():
        first = cart.reset()
        (origin,) = env.plant.origins()
        frames, observation = [cart.frame], first.observation
        try:
            while not done:  # the cart waits for this loop; the rest is done afterwards
                action = chosen_action(policy, observation)
                guarded.append(cart.sent_motor(action) != cart.motor(action))
                step = cart.step(action)
                motors.append(cart.sent)
                frames.append(cart.frame)
                steps.append(step)
                observation, (done,) = step.observation, step.done
        finally:
            env.plant.halt()  # a real cart would keep its last motor value
    ending = ending_of(env, action, steps[-1].truncated[0], steps[-1].state[2])
    episode = one_episode(env, first, steps, frames, np.array(motors), np.array(guarded), ending)
    return replace(episode, origin=origin)


def chosen_action(policy: Policy, observation: Sequence[float]) -> int:
    """Return the policy's action on the observation of one cart."""
    observed = torch.from_numpy(np.array([observation], np.float32))
    return int(choose(policy, tensordict_of({"observation": observed})))


def one_episode(
    env: CartPoleEnv,
    first: Percept[Numbers],
    steps: Sequence[Percept[Numbers]],
    frames: Sequence[PlantOutput[Numbers]],
    motor: np.ndarray,
    guarded: np.ndarray,
    ending: str,
) -> Episode:
    """Return the episode of one cart from its percepts, its frames, and its motor values, guarded or not.

    What follows on a count that froze or jumped is left out; no control period may be left.
    """
    columns = {key: np.array([getattr(step, key) for step in steps])[:, 0] for key in _FROM_NEXT}
    columns["state"] = np.array([first.state, *(step.state for step in steps)])
    columns["counts"] = np.array([frame.counts for frame in frames])
    columns["time"] = np.cumsum([0.0, *(frame.dt[0] for frame in frames[1:])])
    columns |= {"motor": motor, "guarded": guarded}
    episode = _episode(columns, ending, env)
    measured = measured_part(episode, env.plant.fault, env.plant.hardware)
    if measured.left_out:
        env.plant.distrust()
    return measured


@torch.no_grad()
def run_many(env: CartPoleEnv, policy: Policy, knocks: Knocks | None = None) -> list[Episode]:
    """Return one episode of each cart of any plant, all from one reset, on tensors."""
    current = env.reset()
    frames, actions = [current], []
    endings: list[str | None] = [None] * env.plant.carts
    try:
        if knocks:
            knocks.reset()
        origins = env.plant.origins()
        while None in endings:  # the cart waits for this loop; the rest is done afterwards
            action = choose(policy, current)
            if knocks:
                knocks()
            outcome = env.step(current.set("action", action)).get("next")
            if env.on_step is not None:
                env.on_step(current)
            actions.append(action)
            frames.append(outcome)
            if outcome.get("done").any():
                _note_endings(env, action, outcome, endings)
            current = outcome.exclude("reward")
    finally:
        env.plant.halt()  # a real cart would keep its last motor value
    first, steps = frames[0], frames[1:]
    columns = {key: torch.cat([step[key] for step in steps], 1) for key in _FROM_NEXT}
    columns |= {key: torch.stack([frame[key] for frame in frames], 1) for key in ("state", "counts")}
    action, guard = torch.stack(actions, 1), torch.cat([frame["guard"] for frame in frames[:-1]], 1)
    columns["motor"] = env.hardware.sent_motors(action, guard)
    columns["guarded"] = env.hardware.guarded(action, guard)
    dt = torch.cat([torch.zeros_like(first["dt"]), *(step["dt"] for step in steps)], 1)
    columns["time"] = dt.cumsum(1)
    arrays = {key: values.cpu().numpy() for key, values in columns.items()}
    return [
        replace(
            _episode({key: values[row] for key, values in arrays.items()}, ending, env), origin=origins[row]
        )
        for row, ending in enumerate(endings)
        if ending
    ]


def _note_endings(
    env: CartPoleEnv, action: Tensor, outcome: TensorDictBase, endings: list[str | None]
) -> None:
    """Fill in the reason for each cart whose first episode ends in this step."""
    for row in outcome["done"].squeeze(-1).nonzero().squeeze(-1).tolist():
        if endings[row] is None:
            last = outcome[row]
            endings[row] = ending_of(env, int(action[row]), last["truncated"].item(), last["state"][2].item())


def ending_of(env: CartPoleEnv, action: int, truncated: bool, theta: float) -> str:
    """Return why an episode ended after `action`, at `theta` rad."""
    reported = env.plant.ended_by
    if reported:
        return str(Ending(reported))
    if action == NO_ACTION:
        return str(Ending.NON_FINITE)
    if truncated:
        return str(Ending.TIME)
    limit = env.hardware.task.angle_limit
    fallen = limit is not None and abs(theta) > limit
    return str(Ending.ANGLE if fallen else Ending.TRACK)


def _episode(columns: dict[str, np.ndarray], ended_by: str, env: CartPoleEnv) -> Episode:
    """Return the episode of one row, cut at its end."""
    steps = 1 + int(np.argmax(columns["done"]))
    x, x_dot, theta, theta_dot = columns["state"][: steps + 1].astype(np.float64).T
    step = {key: values[:steps] for key, values in columns.items()}
    return Episode(
        time=columns["time"][: steps + 1].astype(np.float64),
        x=x,
        x_dot=x_dot,
        theta=np.unwrap(theta),
        theta_dot=theta_dot,
        counts=columns["counts"][: steps + 1].astype(np.int64),
        motor=step["motor"].astype(np.int64),
        score=step["score"].astype(np.float64),
        score_upright=step["score_upright"].astype(np.float64),
        reward=step["reward"].astype(np.float64),
        ended_by=ended_by,
        guarded=None if env.hardware.guard is None else step["guarded"],
        encoders=env.plant.hardware.encoders,
    )


def run_onboard_episodes(env: CartPoleEnv, policy: Policy, episodes: int) -> Iterator[Episode]:
    """Yield episodes of the cart's board, with the motor values that `policy` would have chosen here.

    Raises RefusedError if the board has no policy, FaultError if nothing was measured, and the errors of the
    plant's reset.
    """
    policy = prepared(env, policy)
    yield from with_periods(run_onboard(env, policy) for _ in range(episodes))


@torch.no_grad()
def run_onboard(env: CartPoleEnv, policy: Policy) -> Episode:
    """Return an episode of the cart's board. `motor` is that of `SerialPlant.drove`."""
    plant, cart, steps, motors, done = env.plant, env.one_cart, [], [], False
    assert isinstance(plant, SerialPlant)
    with no_garbage_collection(), on_board(plant):
        first = cart.reset()
        frames, stopped = [cart.frame], [False]
        try:
            while not done:
                frame = plant.listen_one()
                step = cart.advance(frame.motor_applied[0], frame)
                motors.append(plant.drove(frame.motor_applied[0]))
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
    ending = ending_of(env, 0, steps[-1].truncated[0], steps[-1].state[2])
    episode = one_episode(env, first, steps, frames, np.array(motors), expected != chosen, ending)
    longest = LATE_PERIODS * plant.cart.information.period_us * 1e-6  # s; longer: states were missed
    gaps = np.array(stopped) | (np.array([frame.dt[0] for frame in frames]) > longest)
    observed = env.hardware.observation_settings
    memory = max(observed.past_motors, observed.past_velocities, observed.past_positions)
    compared = comparable(gaps[1:], memory, ending)
    return replace(episode, expected=expected[: episode.steps], compared=compared[: episode.steps])


def comparable(gaps: NDArray[np.bool_], memory: int, ending: str) -> NDArray[np.bool_]:
    """Return [T] in which periods board and computer chose from the same observation.

    `gaps` [T]: before the state at the end of the period, a state was missed, or the watchdog or a limit
    held the motor. `memory` is the number of past periods that the agent observes.
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
