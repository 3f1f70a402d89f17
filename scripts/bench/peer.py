#!/usr/bin/env python
"""Stable-Baselines3's DQN beside ours: seconds until each holds 0.9 of the reference on the medium pole.

    pip install "stable-baselines3>=2.7"
    scripts/bench/peer.py --seeds 3 --times 10 --json peer.json

Both learn on the same simulated carts with the same observation, reward and randomization, theirs through the
Gymnasium registration (the vector entry point), and are judged on the nominal cart from the same 20 starts.
Its settings are the best of those that were tried by hand: see SETTINGS. Ours is `cartpole-train
experiment=medium`. One training at a time, `--threads` for each.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from tensordict import TensorDict

from cartpole_rl.envs.gymnasium import simulated_environment
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.reporting.table import table
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.workflows.build import use_threads

try:
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    sys.exit(
        f'peer.py: {error}; the peer is no part of an installation: pip install "stable-baselines3>=2.7"'
    )

REFERENCE = json.loads(Path(__file__).with_name("references.json").read_text())["medium"]["score"]
REACHED = 0.9
STARTS = 20
SETTINGS: dict[str, Any] = {
    "learning_rate": 1e-3,
    "buffer_size": 1_000_000,
    "learning_starts": 20_000,
    "batch_size": 512,
    "tau": 0.01,
    "target_update_interval": 1,
    "gamma": 0.99,
    "n_steps": 5,
    "train_freq": 8,  # steps of all carts
    "exploration_initial_eps": 0.5,
    "exploration_final_eps": 0.02,
    "exploration_fraction": 0.1,
    "policy_kwargs": {"net_arch": [128, 128]},
}
CARTS, UPDATES, TRANSITIONS = 128, 16, 20_000_000


class ManyCarts(VecEnv):
    """Gymnasium's vector entry point as Stable-Baselines3 wants it."""

    def __init__(self, carts: int, seed: int) -> None:
        self.carts = gymnasium.make_vec(
            "cartpole_rl/SwingUp-v0",
            num_envs=carts,
            vectorization_mode="vector_entry_point",
            randomization="wide",
            compiled=True,
        )
        self.first_seed: int | None = seed
        self.render_mode = None
        super().__init__(carts, self.carts.single_observation_space, self.carts.single_action_space)

    def reset(self) -> np.ndarray:
        """First observations [N, K]."""
        observation, _ = self.carts.reset(seed=self.first_seed)
        self.first_seed = None
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions."""
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations [N, K], rewards [N], ends [N], what the end looked like."""
        observation, reward, terminated, truncated, seen = self.carts.step(self.actions)
        done = terminated | truncated
        info: list[dict[str, Any]] = [{} for _ in done]
        for row in np.flatnonzero(done):
            info[row] = {
                "terminal_observation": seen["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row]),
            }
        return observation, reward, done, info

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for each cart."""
        return [getattr(self.carts, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Carts have no attributes of their own."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Carts have no methods of their own."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No."""
        return [False] * self.num_envs


class Judge(BaseCallback):
    """Evaluates at intervals with the clock stopped, and ends at `REACHED` or after `limit` s."""

    def __init__(self, every: int, limit: float) -> None:
        super().__init__()
        self.every, self.limit = every, limit
        self.env = simulated_environment("swingup", STARTS)
        self.course: list[dict[str, float]] = []
        self.judging, self.started, self.next = 0.0, time.perf_counter(), every

    def _on_step(self) -> bool:
        if self.num_timesteps < self.next:
            return True
        self.next += self.every
        now = time.perf_counter()
        self.env.set_seed(evaluation_seed(0))
        episodes = run_batch(self.env, self.policy)
        score = float(np.mean([episode.score.sum() for episode in episodes]))
        seconds = now - self.started - self.judging
        self.judging += time.perf_counter() - now
        self.course.append({"transitions": self.num_timesteps, "seconds": seconds, "score": score})
        print(
            f"{self.num_timesteps} transitions, {seconds:.0f} s, score {score:.0f}",
            file=sys.stderr,
            flush=True,
        )
        return score < REACHED * REFERENCE and seconds < self.limit

    def policy(self, present: TensorDict) -> TensorDict:
        """Greedy actions."""
        import torch

        action, _ = self.model.predict(present["observation"].numpy(), deterministic=True)
        return present.set("action", torch.as_tensor(action))


def theirs(seed: int, limit: float) -> list[dict[str, float]]:
    """Course of a training by Stable-Baselines3."""
    model = DQN("MlpPolicy", ManyCarts(CARTS, seed), seed=seed, gradient_steps=UPDATES, **SETTINGS)
    judge = Judge(200_000, limit)
    model.learn(TRANSITIONS, callback=judge)
    return judge.course


def ours(seed: int, threads: int) -> list[dict[str, float]]:
    """Course of a training by cartpole-train."""
    with tempfile.TemporaryDirectory() as folder:
        command = [Path(sys.executable).with_name("cartpole-train"), "experiment=medium", f"seed={seed}"]
        subprocess.run(
            [*command, f"threads={threads}", f"hydra.run.dir={folder}"], check=True, capture_output=True
        )
        return [json.loads(line) for line in (Path(folder) / "history.jsonl").read_text().splitlines()]


def seconds_to_reached(course: list[dict[str, float]]) -> float:
    """When 0.9 first holds; infinite if it never does."""
    return next((each["seconds"] for each in course if each["score"] >= REACHED * REFERENCE), math.inf)


def main() -> None:
    """Train both, seed by seed, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="seeds 0 to this less one")
    parser.add_argument("--times", type=float, default=10, help="theirs is given up after so many times ours")
    parser.add_argument("--threads", type=int, default=1, help="of torch, for each training")
    parser.add_argument("--json", type=Path, help="file for the courses")
    given = parser.parse_args()
    use_threads(given.threads)
    everything, rows = {}, []
    for seed in range(given.seeds):
        course = ours(seed, given.threads)
        own = seconds_to_reached(course)
        limit = given.times * min(own, course[-1]["seconds"])  # of all of ours where it never got there
        peers = theirs(seed, limit)
        everything[seed] = {"ours": course, "stable-baselines3": peers}
        peer = seconds_to_reached(peers)
        best = max(each["score"] for each in peers) / REFERENCE
        beyond = f"over {given.times:.1f}" if math.isfinite(own) else "neither"
        ratio = f"{peer / own:.1f}" if math.isfinite(peer) else beyond
        rows.append(
            {
                "seed": str(seed),
                "ours, s": f"{own:.0f}" if math.isfinite(own) else "never",
                "Stable-Baselines3, s": f"{peer:.0f}" if math.isfinite(peer) else f"not in {limit:.0f}",
                "its best fraction": f"{best:.3f}",
                "ratio": ratio,
            }
        )
        print(table(rows, {key: key for key in rows[0]}), flush=True)
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
