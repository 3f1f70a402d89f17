"""The training loop: collect, learn, evaluate, in that order.

`snapshot` holds everything that the next iteration depends on, so a resumed run equals one that was never
interrupted, to the bit. Schedules are functions of the progress.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.agents.loss import Columns, LossGradient, columns_of
from cartpole_rl.devices import moved
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.learning.buffer import NStepReturns, buffer_snapshot, make_buffer, restore_buffer
from cartpole_rl.learning.collector import Collector
from cartpole_rl.learning.randomness import random_state, restore_random_state
from cartpole_rl.learning.schedules import half_cosine, linear
from cartpole_rl.learning.settings import BufferSettings, LearningSettings, OptimizerSettings
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import Measure

Scalars = dict[str, float]
OPTIMIZERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}


class Monitor(Protocol):
    """Callbacks of a training."""

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Report an iteration; called about 200 times in a training."""

    def on_evaluation(self, training: "Training", episodes: Sequence[Episode], is_best: bool) -> None:
        """Report an evaluation."""

    def on_checkpoint(self, training: "Training") -> None:
        """Save the state of the training."""


class Training:
    """A DQN training of `agent` on `env`, both on one device, where all its tensors are.

    `evaluate` runs the greedy policy on another plant, on any device; `measure` is the score that judges it.
    """

    def __init__(
        self,
        settings: LearningSettings,
        buffer: BufferSettings,
        optimizer: OptimizerSettings,
        agent: QAgent,
        env: CartPoleEnv,
        evaluate: Callable[[], list[Episode]],
        monitor: Monitor,
        seed: int,
        compiled: bool = False,
        measure: Measure = "score",
    ) -> None:
        self.settings, self.agent, self.env = settings, agent, env
        self.measure = measure
        self.evaluate, self.monitor, self.seed = evaluate, monitor, seed
        self.collector = Collector(
            env, agent.actor, len(env.hardware.motors), seed, settings.retry_probability
        )
        self.buffer_settings, self.optimizer_settings = buffer, optimizer
        self.returns = NStepReturns(settings.n_step, agent.settings.gamma, settings.carry)
        self.buffer = make_buffer(buffer, settings.updates * settings.batch_size, env.device)
        self.gradient = LossGradient(agent.loss, optimizer.max_grad_norm, compiled)
        self.weights = self.gradient.weights
        self.optimizer = OPTIMIZERS[optimizer.kind](
            self.weights, lr=optimizer.learning_rate, weight_decay=optimizer.weight_decay, fused=True
        )
        self.iteration, self.seconds = 0, 0.0
        self.best_score = -float("inf")
        self.last_score: float | None = None

    @property
    def transitions(self) -> int:
        """Transitions collected so far."""
        return self.iteration * self.settings.carts * self.settings.chunk

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return int(self.agent.updates)

    @property
    def progress(self) -> float:
        """Completed share of the training, 0 to 1."""
        return self.iteration / self.settings.iterations

    def run(self) -> None:
        """Train from the current iteration to the end."""
        settings = self.settings
        evaluate_at = evenly_spaced(settings.evaluations, settings.iterations)
        checkpoint_at = evaluate_at[:: -settings.checkpoint_interval]  # counted from the end, which is one
        while self.iteration < settings.iterations:
            chunk, scalars = self.iterate()
            if self.iteration % max(1, settings.iterations // 200) == 0:
                self.monitor.on_update(self.transitions, scalars | self.describe(chunk))
            if self.iteration in evaluate_at:
                self.run_evaluation()
            if self.iteration in checkpoint_at:
                self.monitor.on_checkpoint(self)

    def iterate(self) -> tuple[TensorDictBase, Scalars]:
        """Collect a chunk and learn; return the chunk and the scalars of `learn`."""
        with self.timed():
            chunk = self.collect()
            self.iteration += 1
            return chunk, self.learn() if self.transitions > self.settings.warmup_transitions else {}

    def collect(self) -> TensorDictBase:
        """Collect a chunk [N, T] and add its n-step transitions to the buffer."""
        self.collector.epsilon = self.epsilon()
        chunk = self.collector.collect(self.settings.chunk)
        self.buffer.extend(self.returns(chunk))
        return chunk

    def sample(self) -> TensorDictBase:
        """Return the transitions of one iteration's updates, `updates` batches long."""
        return self.buffer.sample()

    def learn(self) -> Scalars:
        """Make one iteration's updates; return mean loss, mean gradient norm and learning rate."""
        optimizer, beta = self.optimizer_settings, self.buffer_settings.beta
        rate = half_cosine(
            optimizer.learning_rate, optimizer.learning_rate * optimizer.learning_rate_end, self.progress
        )
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        if self.buffer_settings.kind == "prioritized":
            self.buffer.sampler.beta = linear(*beta, self.progress)
        sample = self.sample()
        batches = zip(*(column.split(self.settings.batch_size) for column in columns_of(sample)), strict=True)
        losses, norms, errors = zip(*map(self.update, batches), strict=True)
        if self.buffer_settings.kind == "prioritized":
            self.buffer.update_tensordict_priority(sample.set("td_error", torch.cat(errors)))
        return {
            "learning/loss": torch.stack(losses).mean().item(),
            "learning/gradient_norm": torch.stack(norms).mean().item(),
            "learning/learning_rate": rate,
        }

    def update(self, batch: Columns) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Make a gradient step; return the loss, its gradient's norm and the error of each transition.

        Raises LearningError, before the step, if the loss or its gradient is not finite.
        """
        loss, norm, errors = self.gradient(batch)
        if not math.isfinite(loss.item() + norm.item()):
            raise LearningError(
                f"learning diverged after {self.transitions} transitions: the loss is {loss.item():g}, its "
                f"gradient's norm {norm.item():g}; earlier checkpoints are kept; try a smaller "
                f"optimizer.learning_rate than {self.optimizer_settings.learning_rate:g}"
            )
        self.optimizer.step()
        self.agent.update_target()
        return loss, norm, errors

    def run_evaluation(self) -> None:
        """Evaluate the greedy policy and report the episodes to the monitor."""
        with self.timed():
            episodes = self.evaluate()
        self.last_score = float(np.mean([episode.total(self.measure) for episode in episodes]))
        is_best = self.last_score > self.best_score
        self.best_score = max(self.best_score, self.last_score)
        self.monitor.on_evaluation(self, episodes, is_best)

    def epsilon(self) -> float:
        """Return the share of random actions in the next chunk."""
        settings = self.settings
        if self.transitions < settings.warmup_transitions:
            return 1.0
        return linear(
            *settings.epsilon, (self.transitions - settings.warmup_transitions) / settings.epsilon_transitions
        )

    @torch.no_grad()
    def describe(self, chunk: TensorDictBase) -> Scalars:
        """Return the scalars to plot beside those of `learn`."""
        value = self.agent.actor(chunk[:, 0].select("observation"))["chosen_action_value"]
        scalars = {
            "learning/q_mean": value.mean().item(),
            "learning/q_max": value.max().item(),
            "learning/epsilon": self.collector.epsilon,
            "learning/updates": float(self.updates),
            "speed/transitions_per_second": self.transitions / self.seconds,
        }
        explored = self.collector.finished() | self.collector.guarded_fraction()
        return scalars | {f"exploration/{key}": value for key, value in explored.items()}

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Add the time within the context to `seconds`: that of collecting, learning and evaluating."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - started

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the training, to be saved at once: it shares memory with the training."""
        return {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "measure": self.measure,
            "scores": [self.best_score, self.last_score],
            "agent": self.agent.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "replay": buffer_snapshot(self.buffer),
            "returns": self.returns.snapshot(),
            "collector": self.collector.snapshot(),
            "plant": self.env.plant.snapshot(),
            "random": random_state(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`; scores in another measure than this training's are forgotten."""
        self.iteration = snapshot["iteration"]
        self.seconds = snapshot["seconds"]
        if snapshot.get("measure", "score") == self.measure:  # missing in those of earlier versions: (6.2)
            self.best_score, self.last_score = snapshot["scores"]
        else:
            self.best_score, self.last_score = -float("inf"), None
        self.agent.load_state_dict(snapshot["agent"])
        self.optimizer.load_state_dict(snapshot["optimizer"])
        restore_buffer(self.buffer, snapshot["replay"])
        self.returns.restore(moved(snapshot["returns"], self.env.device))
        self.collector.restore(snapshot["collector"])
        self.env.plant.restore(snapshot["plant"])
        restore_random_state(snapshot["random"])


def evenly_spaced(count: int, end: int) -> list[int]:
    """Return `count` evenly spaced integers, of which the last is `end`."""
    return [round(end * (index + 1) / count) for index in range(count)]
