#!/usr/bin/env python
"""How much faster than Stable-Baselines3's DQN does cartpole-train learn the medium pole?

    pip install "stable-baselines3>=2.7"
    scripts/bench/peer.py --seeds 3 --times 10 --json peer.json

Measures the seconds until the score reaches 0.9 of the reference. Both train on the same simulated carts
with the same observation, reward and randomization, Stable-Baselines3 through the Gymnasium registration
(the vector entry point), and both are judged on the nominal cart from the same 100 hanging starts. The
settings of Stable-Baselines3 (SETTINGS in this file) are the best of those tried by hand; ours are
`cartpole-train experiment=medium`. One training runs at a time.
"""

import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from common import (
    add_seed_options,
    chosen_seeds,
    option_parser,
    print_table,
    reference_scores,
    run_once,
    write_json,
)
from tensordict import TensorDict

from cartpole_rl.envs.build import with_fitted_guard
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import judge, nominal_env

try:
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    sys.exit(f'peer.py: {error}; install it: pip install "stable-baselines3>=2.7"')

REFERENCE = reference_scores()["medium"]
REACHED = 0.9
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
    """Gymnasium's vector entry point behind the interface of Stable-Baselines3."""

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
        """Return the first observations [N, K]."""
        observation, _ = self.carts.reset(seed=self.first_seed)
        self.first_seed = None
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions [N] for step_wait."""
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return observations [N, K], rewards [N], done [N] and the final observations of done rows."""
        observation, reward, terminated, truncated, extra = self.carts.step(self.actions)
        done = terminated | truncated
        info: list[dict[str, Any]] = [{} for _ in done]
        for row in np.flatnonzero(done):
            info[row] = {
                "terminal_observation": extra["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row]),
            }
        return observation, reward, done, info

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the same value for each cart."""
        return [getattr(self.carts, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise NotImplementedError: single carts have no attributes."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Raise NotImplementedError: single carts have no methods."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each cart."""
        return [False] * self.num_envs


class Judge(BaseCallback):
    """Evaluates at intervals with the clock stopped; ends the training at `REACHED` or after `limit` s."""

    def __init__(self, seed: int, every: int, limit: float) -> None:
        super().__init__()
        self.seed, self.every, self.limit = seed, every, limit
        config = with_fitted_guard(load_settings(TrainConfig, {"seed": seed, "compile": False}))
        self.env = nominal_env(config)  # that of our own evaluations
        self.history: list[dict[str, float]] = []
        self.judging, self.started, self.next = 0.0, time.perf_counter(), every

    def _on_step(self) -> bool:
        if self.num_timesteps < self.next:
            return True
        self.next += self.every
        now = time.perf_counter()
        score = float(np.mean([each.score.sum() for each in judge(self.env, self.policy, self.seed)]))
        seconds = now - self.started - self.judging
        self.judging += time.perf_counter() - now
        self.history.append({"transitions": self.num_timesteps, "seconds": seconds, "score": score})
        print(
            f"{self.num_timesteps} transitions, {seconds:.0f} s, score {score:.0f}",
            file=sys.stderr,
            flush=True,
        )
        return score < REACHED * REFERENCE and seconds < self.limit

    def policy(self, present: TensorDict) -> TensorDict:
        """Add greedy actions."""
        import torch

        action, _ = self.model.predict(present["observation"].numpy(), deterministic=True)
        return present.set("action", torch.as_tensor(action))


def theirs(seed: int, limit: float) -> list[dict[str, float]]:
    """Return the evaluations of a training by Stable-Baselines3."""
    model = DQN("MlpPolicy", ManyCarts(CARTS, seed), seed=seed, gradient_steps=UPDATES, **SETTINGS)
    judging = Judge(seed, 200_000, limit)
    model.learn(TRANSITIONS, callback=judging)
    return judging.history


def ours(seed: int, threads: int) -> list[dict[str, float]]:
    """Return the evaluations of a training by cartpole-train."""
    with tempfile.TemporaryDirectory() as folder:
        run = run_once(Path(folder), "train", "experiment=medium", f"seed={seed}", f"threads={threads}")
        return [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]


def seconds_to_reached(history: list[dict[str, float]]) -> float:
    """Return when the score first reaches 0.9 of the reference; infinity if it never does."""
    return next((each["seconds"] for each in history if each["score"] >= REACHED * REFERENCE), math.inf)


def row(seed: int, own: float, peers: list[dict[str, float]], times: float, limit: float) -> dict[str, str]:
    """Return the table row of one seed; `own` is our seconds, `peers` the evaluations of the peer."""
    peer = seconds_to_reached(peers)
    best = max(each["score"] for each in peers) / REFERENCE
    unreached = f"over {times:.1f}" if math.isfinite(own) else "neither"
    return {
        "seed": str(seed),
        "ours, s": f"{own:.0f}" if math.isfinite(own) else "never",
        "Stable-Baselines3, s": f"{peer:.0f}" if math.isfinite(peer) else f"not in {limit:.0f}",
        "its best fraction": f"{best:.3f}",
        "ratio": f"{peer / own:.1f}" if math.isfinite(peer) else unreached,
    }


def main() -> None:
    """Train both, seed by seed, print a table and write the figures."""
    parser = option_parser(__doc__)
    add_seed_options(parser, seeds=3)
    parser.add_argument(
        "--times", type=float, default=10, help="stop the peer after this many times our seconds (10)"
    )
    parser.add_argument("--threads", type=int, default=1, help="torch threads of each training (1)")
    options = parser.parse_args()
    use_threads(options.threads)
    everything, rows = {}, []
    for seed in chosen_seeds(options):
        history = ours(seed, options.threads)
        own = seconds_to_reached(history)
        limit = options.times * min(own, history[-1]["seconds"])  # our whole training if it never got there
        peers = theirs(seed, limit)
        everything[seed] = {"ours": history, "stable-baselines3": peers}
        rows.append(row(seed, own, peers, options.times, limit))
        print_table(rows)
    write_json(options.json, everything)


if __name__ == "__main__":
    main()
