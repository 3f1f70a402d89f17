"""Deep Q-learning in one sitting: collect, replay, n-step returns, target, loss, update, evaluate.

`Training.run` is the loop; `AdvantageLearningLoss.forward` writes out the target. Actor, replay buffer and
base class of the loss are TorchRL's; docs/torchrl.md says why the rest is not.
"""

import math
import time
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import DQNLoss, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss

from cartpole_rl.compilation import Columns, LossGradient, acting_with
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.learning.retries import Retries
from cartpole_rl.learning.settings import BufferSettings, LearningSettings, OptimizerSettings, linear
from cartpole_rl.learning.states import Resumable, make_buffer
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import Measure

if TYPE_CHECKING:
    from cartpole_rl.learning.agent import QAgent

NEXT: tuple[NestedKey, ...] = ("next", "observation"), ("next", "reward"), ("next", "terminated")
COLLECTED: tuple[NestedKey, ...] = ("observation", "action", "guard", *NEXT, ("next", "done"))
LEARNED: tuple[NestedKey, ...] = ("observation", "action", "steps_to_next_obs", *NEXT)
OPTIMIZERS = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}
LARGEST_ERROR = 1e30  # squared: priorities of 32 bits, and their sum over any buffer, are then finite
FEW_EPISODES = 2.5  # of each cart in a full buffer
Scalars = dict[str, float]


class Monitor:
    """Callbacks of a training; these do nothing."""

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Report an iteration; called about 200 times in a training."""

    def on_evaluation(self, training: "Training", episodes: Sequence[Episode], is_best: bool) -> None:
        """Report an evaluation."""

    def on_checkpoint(self, training: "Training") -> None:
        """Save the state of the training."""


class Training(Resumable):
    """A DQN training of `agent` on `env`, both on one device, where all its tensors are.

    `evaluate` runs the greedy policy on another plant, on any device; `measure` is the score that judges it.
    """

    rate_setting = "optimizer.learning_rate"  # on the command line

    def __init__(
        self,
        settings: LearningSettings,
        buffer: BufferSettings,
        optimizer: OptimizerSettings,
        agent: "QAgent",
        env: CartPoleEnv,
        evaluate: Callable[[], list[Episode]],
        monitor: Monitor,
        seed: int,
        compiled: bool = False,
        measure: Measure = "score",
    ) -> None:
        self.settings, self.buffer_settings, self.optimizer_settings = settings, buffer, optimizer
        self.agent, self.env, self.evaluate, self.monitor = agent, env, evaluate, monitor
        self.seed, self.measure = seed, measure
        self.random = torch.Generator(device=env.device).manual_seed(seed)  # of exploration
        self.retries = Retries(env, settings.retry_probability, self.random)
        self.buffer = make_buffer(buffer, settings.updates * settings.batch_size, env.device)
        self.gradient = LossGradient(agent.loss, LEARNED, optimizer.max_grad_norm, compiled)
        self.optimizer = OPTIMIZERS[optimizer.kind](
            self.gradient.weights, optimizer.learning_rate, weight_decay=optimizer.weight_decay, fused=True
        )
        self.iteration, self.seconds = 0, 0.0
        self.best_score, self.last_score = -math.inf, None
        self.start_episodes()

    def start_episodes(self) -> None:
        """Start a new episode on every cart.

        Carts that all start at once stay in step: the buffer then holds the starts of one policy only, and
        nothing corrects an agent that begins to leave the pole hanging until all start again.
        """
        self.current = self.env.reset()
        begun: Tensor | int = 0
        if self.staggers:
            carts, periods = self.settings.carts, self.env.hardware.task.periods
            begun = torch.arange(carts, device=self.env.device) * periods // carts
            self.current["step_count"] = begun.unsqueeze(1)
        self.retries.reset(begun)
        self.waiting: TensorDictBase | None = None  # [N, n - 1], the last periods if their returns go on

    @property
    def staggers(self) -> bool:
        """True if the first episodes end one after the other; by default where the buffer is short."""
        if self.settings.staggered is not None:
            return self.settings.staggered
        episodes = self.buffer_settings.size / self.settings.carts / self.env.hardware.task.periods
        return episodes < FEW_EPISODES

    @property
    def transitions(self) -> int:
        """Transitions collected so far."""
        return self.iteration * self.settings.carts * self.settings.chunk

    @property
    def progress(self) -> float:
        """Completed share of the training, 0 to 1."""
        return self.iteration / self.settings.iterations

    def run(self) -> None:
        """Train from the current iteration to the end."""
        iterations = self.settings.iterations
        while self.iteration < iterations:
            chunk, scalars = self.iterate()
            if self.iteration % max(1, iterations // 200) == 0:
                self.monitor.on_update(self.transitions, scalars | self.describe(chunk))
            if self.iteration in self.settings.evaluated_iterations:
                self.run_evaluation()
            if self.iteration in self.settings.saved_iterations:
                self.monitor.on_checkpoint(self)

    def iterate(self) -> tuple[TensorDictBase, Scalars]:
        """Collect a chunk and learn; return the chunk and the scalars of `learn`."""
        started = time.perf_counter()
        chunk = self.collect()
        self.iteration += 1
        scalars = self.learn() if self.transitions > self.settings.warmup_transitions else {}
        self.seconds += time.perf_counter() - started
        return chunk, scalars

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Drive all carts for a chunk of periods [N, T]; add its n-step transitions to the buffer."""
        self.epsilon, steps = self.settings.exploration(self.transitions), []
        for _ in range(self.settings.chunk):
            stepped = self.env.step(self.current.set("action", self.act(self.current)))
            steps.append(stepped.select(*COLLECTED))
            self.current = self.env.advance(stepped, self.retries.record(stepped["next"]))
        chunk: TensorDictBase = torch.stack(steps, 1)
        self.buffer.extend(self.returns(chunk.exclude("guard")))
        return chunk

    def act(self, current: TensorDictBase) -> Tensor:
        """Return epsilon-greedy actions [N]."""
        carts, draws = self.env.batch_size, {"generator": self.random, "device": self.env.device}
        action = torch.randint(len(self.env.hardware.motors), carts, **draws)
        if self.epsilon == 1:
            return action
        explore = torch.rand(carts, **draws) < self.epsilon
        return torch.where(explore, action, self.agent.actor(current.select("observation"))["action"])

    def returns(self, chunk: TensorDictBase) -> TensorDictBase:
        """Return the n-step transitions of a chunk.

        With `carry` its last n - 1 periods wait for the next chunk, so that every return has n steps or ends
        with its episode. Without, the mean return in a chunk of T periods has n - n (n - 1) / (2 T) steps.
        """
        held = self.settings.steps - 1 if self.settings.carry else 0
        steps = chunk if self.waiting is None else torch.cat((self.waiting, chunk), 1)
        self.waiting = steps[:, -held:].clone() if held else None
        return n_step_transitions(steps, self.settings.steps, self.agent.settings.discount, held)

    def sample(self) -> TensorDictBase:
        """Return the transitions of one iteration's updates, `updates` batches long."""
        return self.buffer.sample()

    def learn(self) -> Scalars:
        """Make one iteration's updates; return mean loss, mean gradient norm and learning rate."""
        rate = self.optimizer_settings.rate(self.progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        if prioritized := self.buffer_settings.kind == "prioritized":
            self.buffer.sampler.beta = linear(*self.buffer_settings.beta, self.progress)
        sample = self.sample()
        columns = [column.split(self.settings.batch_size) for column in self.gradient.columns(sample)]
        losses, norms, errors = zip(*map(self.update, zip(*columns, strict=True)), strict=True)
        if prioritized:
            error = torch.cat(errors)
            largest = error.max().item()
            if not largest < LARGEST_ERROR ** (1 / max(1, self.buffer_settings.alpha)):
                raise self.diverged(f"a squared error is {largest:g}")
            self.buffer.update_tensordict_priority(sample.set("td_error", error))
        loss, norm = (torch.stack(each).mean().item() for each in (losses, norms))
        return {"learning/loss": loss, "learning/gradient_norm": norm, "learning/learning_rate": rate}

    def update(self, batch: Columns) -> tuple[Tensor, Tensor, Tensor]:
        """Make a gradient step; return the loss, its gradient's norm and the error of each transition.

        Raises LearningError, before the step, if the loss or its gradient is not finite.
        """
        loss, norm, errors = self.gradient(batch)
        if not math.isfinite(loss.item() + norm.item()):
            raise self.diverged(f"the loss is {loss.item():g}, its gradient's norm {norm.item():g}")
        self.optimizer.step()
        self.agent.update_target()
        return loss, norm, errors

    def diverged(self, how: str) -> LearningError:
        """Return the error that ends a training."""
        kept = "" if self.last_score is None else "earlier checkpoints are kept; "  # of evaluations
        return LearningError(
            f"learning diverged after {self.transitions} transitions: {how}; {kept}try a smaller "
            f"{self.rate_setting} than {self.optimizer_settings.learning_rate:g}"
        )

    def run_evaluation(self) -> None:
        """Evaluate the greedy policy and report the episodes to the monitor."""
        started = time.perf_counter()
        episodes = self.evaluate()
        self.seconds += time.perf_counter() - started
        score = fmean(episode.total(self.measure) for episode in episodes)
        is_best = score > self.best_score
        self.best_score, self.last_score = max(self.best_score, score), score
        self.monitor.on_evaluation(self, episodes, is_best)

    @torch.no_grad()
    def describe(self, chunk: TensorDictBase) -> Scalars:
        """Return the scalars to plot beside the ones of `learn`."""
        value = self.agent.actor(chunk[:, 0].select("observation"))["chosen_action_value"]
        scalars = {
            "learning/q_mean": value.mean().item(),
            "learning/q_max": value.max().item(),
            "learning/epsilon": self.epsilon,
            "learning/updates": float(self.agent.updates),
            "speed/transitions_per_second": self.transitions / self.seconds,
        }
        if self.env.hardware.guard is not None:
            guarded = self.env.hardware.guarded(chunk["action"], chunk["guard"].squeeze(-1))
            scalars["exploration/guarded_fraction"] = guarded.float().mean().item()
        return scalars | self.retries.describe()


def n_step_transitions(chunk: TensorDictBase, n: int, gamma: float, held: int = 0) -> TensorDictBase:
    """Return the n-step transitions [N * (T - held)] of the one-step transitions `chunk` [N, T].

    A return ends n steps later, or with the episode or the chunk. Next observation and end flags are the last
    step's; `steps_to_next_obs`, the number of steps, sets the discount in the loss. The last `held` periods
    only contribute to the returns of earlier ones.
    """
    carts, periods = chunk.batch_size
    reward, done = chunk["next", "reward"].squeeze(-1), chunk["next", "done"].squeeze(-1)  # [N, T]
    total, reach = reward.clone(), torch.zeros_like(reward, dtype=torch.long)
    alive = torch.ones_like(done)
    for ahead in range(1, min(n, periods)):
        alive = alive[:, :-1] & ~done[:, ahead - 1 : -1]  # [N, T - ahead]
        total[:, :-ahead] += gamma**ahead * reward[:, ahead:] * alive
        reach[:, :-ahead] += alive
    reached = torch.arange(periods, device=reward.device) + reach
    last = chunk["next"][torch.arange(carts, device=reward.device).unsqueeze(1), reached]
    transitions = chunk.select("observation", "action").set("steps_to_next_obs", (reach + 1).unsqueeze(-1))
    transitions["next"] = last.set("reward", total.unsqueeze(-1))
    return transitions[:, : periods - held].flatten(0, 1)


class AdvantageLearningLoss(DQNLoss):
    """TorchRL's DQNLoss with the target of advantage learning; equal to it if `action_gap` is 0.

    It takes the arguments of DQNLoss and `action_gap`, alpha in [0, 1). Advantage learning keeps the value of
    the best action and widens its lead over each other action 1 / (1 - alpha) times: at 50 Hz one action
    changes little, and small errors of the network would hide the best one.
    """

    def __init__(self, *arguments: Any, action_gap: float = 0.0, **named: Any) -> None:
        super().__init__(*arguments, **named)
        if not 0 <= action_gap < 1:
            raise ValueError(f"action_gap={action_gap}: give at least 0 and less than 1")
        if self.action_space not in ("categorical", "one_hot"):
            raise ValueError(f"action_space={self.action_space}: give categorical or one-hot")
        self.action_gap = action_gap

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the `loss` [] of transitions [B]; set their squared TD errors `td_error` [B, 1] in them.

        A transition spans n = `steps_to_next_obs` [B, 1] steps, 1 if that is missing; its reward is their
        discounted sum. theta are the online weights, theta- the target network's.
        """
        keys, following, online = self.tensor_keys, tensordict["next"], self.value_network_params
        reward, alive = following[keys.reward], ~following[keys.terminated]  # [B, 1]
        action = tensordict[keys.action]
        index = action.long().argmax(-1) if self.action_space == "one_hot" else action
        values = self._values(tensordict, online)  # Q(s, .; theta) [B, A]
        value = values.gather(-1, index.view_as(reward))  # Q(s, a; theta) [B, 1]
        with torch.no_grad():
            # Double DQN: van Hasselt et al. 2016 (arXiv:1509.06461), eq. 4 (theta' is theta-); or DQN: eq. 3
            next_values = self._values(following, self.target_value_network_params)  # Q(s', .; theta-) [B, A]
            chooser = self._values(following, online) if self.double_dqn else next_values
            next_value = next_values.gather(-1, chooser.argmax(-1, keepdim=True))
            # n steps: Sutton and Barto 2018, eq. 7.1. No value after the end: Mnih et al. 2015, algorithm 1
            steps = tensordict.get("steps_to_next_obs", torch.ones_like(reward)).view_as(reward)
            discount = alive * self.value_estimator.gamma**steps
            # Advantage learning: Bellemare et al. 2016 (arXiv:1512.04860), eq. 9; V - Q by theta
            shortfall = values.max(-1, keepdim=True).values - value
            target = reward - self.action_gap * shortfall + discount * next_value
        tensordict.set(keys.priority, (value - target).detach().square())
        # Squared error, or Huber's with delta 1 ("error clipping" in Mnih et al. 2015, Methods); its mean, or
        # sum(w loss) / sum(w) with importance weights w (Schaul et al. 2016, arXiv:1511.05952, 3.4)
        loss = distance_loss(value, target, self.loss_function).squeeze(-1)  # [B]
        weights = tensordict.get(keys.priority_weight, None) if self.use_prioritized_weights else None
        reduced = self._reduce_loss(loss, tensordict=tensordict, weights=weights)  # private; as TorchRL's do
        return TensorDict(loss=reduced)

    def _values(self, tensordict: TensorDictBase, weights: TensorDictBase) -> Tensor:
        with acting_with(weights, self.value_network):
            observed = tensordict.select(*self.value_network.in_keys)
            return self.value_network(observed)[self.tensor_keys.action_value]

    def make_value_estimator(
        self, value_type: Any = ValueEstimators.TD0, *, gamma: float = 0.99, device: Any = None
    ) -> None:
        """Set the discount factor. Raises NotImplementedError for any estimator but TD0."""
        supported = [ValueEstimators.TD0]
        dispatch_value_estimator(self, value_type, supported=supported, gamma=gamma, device=device)
