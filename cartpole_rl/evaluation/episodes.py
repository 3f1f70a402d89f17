"""Run whole episodes of a policy on any plant.

A batched plant runs as many episodes at once as it has carts, each from one reset to its own end, so that
short episodes do not come round more often than long ones.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.tasks.actions import NO_ACTION
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode

# reads `observation` [N, K], writes `action` [N] and `action_value` [N, A], which it chose by
Policy = Callable[[TensorDictBase], TensorDictBase]
_FROM_NEXT = ("score", "score_upright", "reward", "done")


def run_episodes(env: CartPoleEnv, policy: Policy, episodes: int) -> Iterator[Episode]:
    """Yield `episodes` episodes. Raises what the plant raises when it cannot be reset."""
    rehearse(env, policy)
    for _ in range(math.ceil(episodes / env.plant.carts)):
        batch = run_batch(env, policy)
        yield from batch[:episodes]
        episodes -= len(batch)


@torch.no_grad()
def rehearse(env: CartPoleEnv, policy: Policy) -> None:
    """Think a step through on zeros, so that what is compiled or loaded at first use delays no tick."""
    blank = env.fake_tensordict()
    choose(policy, blank)
    env.hardware.perceive(blank, env.hardware.command(blank), blank["next"])


def choose(policy: Policy, present: TensorDictBase) -> Tensor:
    """The policy's actions [N]; NO_ACTION where the observation or an action value is not finite.

    The largest of values that are not numbers is the first one, which is full motor to the left.
    """
    seen = present.select("observation")
    finite = seen.get("observation").isfinite().all(-1)
    chosen = policy(seen)
    values = chosen.get("action_value", None)
    if values is not None:
        finite &= values.isfinite().all(-1)
    return chosen.get("action").where(finite, NO_ACTION)


@torch.no_grad()
def run_batch(env: CartPoleEnv, policy: Policy) -> list[Episode]:
    """One episode on each cart, all from one reset."""
    present = env.reset()
    origins = env.plant.origins()
    frames, actions = [present], []
    endings: list[str | None] = [None] * env.plant.carts
    while None in endings:  # a cart waits for what happens here; all that can wait is done below
        action = choose(policy, present)
        following = env.step(present.set("action", action)).get("next")
        actions.append(action)
        frames.append(following)
        if following.get("done").any():
            _note_endings(env, action, following, endings)
        present = following.exclude("reward")
    env.plant.halt()  # a real cart keeps its last motor value
    begin, steps = frames[0], frames[1:]
    columns = {key: torch.cat([step[key] for step in steps], 1) for key in _FROM_NEXT}
    columns |= {key: torch.stack([frame[key] for frame in frames], 1) for key in ("state", "counts")}
    columns["motor"] = env.hardware.motor_values(torch.stack(actions, 1))
    dt = torch.cat([torch.zeros_like(begin["dt"]), *(step["dt"] for step in steps)], 1)
    columns["time"] = dt.cumsum(1)
    arrays = {key: values.cpu().numpy() for key, values in columns.items()}
    return [
        replace(_episode({key: values[row] for key, values in arrays.items()}, ending), origin=origins[row])
        for row, ending in enumerate(endings)
        if ending
    ]


def _note_endings(
    env: CartPoleEnv, action: Tensor, following: TensorDictBase, endings: list[str | None]
) -> None:
    """Fill in the reason for each cart whose first episode ends now."""
    for row in following["done"].squeeze(-1).nonzero().squeeze(-1).tolist():
        if endings[row] is None:
            endings[row] = _ending(env, int(action[row]), following[row])


def _ending(env: CartPoleEnv, action: int, last: TensorDictBase) -> str:
    reported = getattr(env.plant, "ended_by", "")
    if reported:
        return str(Ending(reported))
    if action == NO_ACTION:
        return str(Ending.NON_FINITE)
    if last["truncated"].item():
        return str(Ending.TIME)
    limit = env.hardware.task.angle_limit
    fallen = limit is not None and abs(last["state"][2].item()) > limit
    return str(Ending.ANGLE if fallen else Ending.TRACK)


def _episode(columns: dict[str, np.ndarray], ended_by: str) -> Episode:
    """One row's episode, cut where it ended."""
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
    )
