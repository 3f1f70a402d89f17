"""The learner: an actor of Ray on another machine than the cart's, which learns while the cart drives.

It outlives a lost connection: it waits for the next episode, and ends when no cart asks for it any more.
"""

import os
import secrets
import threading
import time
from functools import partial

from cartpole_rl.errors import CartPoleError
from cartpole_rl.learning.dqn import Scalars
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import new_agent
from cartpole_rl.workflows.build import evaluated_settings, use_threads
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetuning_files import FinetuningFiles
from cartpole_rl.workflows.finetuning_learner import CartLearner, check_simulation
from cartpole_rl.workflows.loading import recorded_settings
from cartpole_rl.workflows.ray_learner.cart_connection import CartConnection
from cartpole_rl.workflows.ray_learner.episode_files import EpisodeFiles, from_tensordict
from cartpole_rl.workflows.ray_learner.offers import pack, unpack
from cartpole_rl.workflows.ray_learner.task import LearnerTask, Report
from cartpole_rl.workflows.tuning import tune

ABANDONED = 3600.0  # s without a call of `report`, after which the learner ends


class Learner:
    """Learns in a thread from its construction on. Ray calls `report` at the same time."""

    def __init__(self, task: LearnerTask) -> None:
        self.task, self.name = task, secrets.token_hex(8)
        self.failure: str | None = None
        self.curves: list[tuple[int, Scalars]] = []
        self.messages: list[str] = []
        self._asked = time.monotonic()
        for run in (self._learn, self._end_when_abandoned):
            threading.Thread(target=run, daemon=True).start()

    def report(self, first: tuple[int, int] = (0, 0)) -> Report:
        """Return the progress from number `first` of the curves and of the messages on."""
        self._asked = time.monotonic()
        curves, messages = first
        return Report(self.name, first, self.curves[curves:], self.messages[messages:], self.failure)

    def _learn(self) -> None:
        try:
            self._tune()
        except CartPoleError as error:
            self.failure = str(error)
        except Exception as error:  # a defect; without this line it would be in a log file of Ray alone
            self.failure = f"{type(error).__name__}: {error}"

    def _tune(self) -> None:
        task = self.task
        config = recorded_settings(FinetuneConfig, task.config, "the run")
        training = recorded_settings(TrainConfig, task.start.config, "the agent")
        evaluation = recorded_settings(EvaluateConfig, task.evaluation, "the run")
        check_simulation(training)
        use_threads(config.threads)
        seed_everything(config.seed)
        new_agent(training)  # `finetune` makes one more than it trains; random numbers agree with its own
        agent = new_agent(training)
        learned, weights = unpack(task.weights, agent.state_dict())
        agent.load_state_dict(weights)
        settings = evaluated_settings(training, evaluation)
        learner = CartLearner(config, training, settings, agent, self.messages.append)
        cart = DistantCart(self, learner)
        tune(cart, learner, learned)
        cart.offer(config.episodes)

    def _end_when_abandoned(self) -> None:
        while time.monotonic() - self._asked < ABANDONED:
            time.sleep(1)
        os._exit(0)


class DistantCart:
    """The cart on the other machine, as `tune` uses it."""

    def __init__(self, actor: Learner, learner: CartLearner) -> None:
        task = actor.task
        self.actor, self.learner, self.config = actor, learner, learner.config
        make_files = partial(EpisodeFiles, FinetuningFiles(task.folder, learner.config))
        count = self.config.evaluation_episodes + self.config.episodes
        self.connection = CartConnection(task.cart, make_files, count, task.weights)

    def offer(self, version: int) -> None:
        """Offer the agent's weights after `version` episodes."""
        self.connection.offer(pack(version, self.learner.agent.state_dict()))

    def recorded(self, learned: int | None = None) -> list[Episode]:
        """Return the evaluation episodes and the first `learned` of those to learn from; None means all."""
        before = self.config.evaluation_episodes
        count = len(self.connection.buffer) if learned is None else before + learned
        return [self._episode(number) for number in range(count)]

    def start_episode(self, number: int) -> None:
        """Offer the weights for episode `number`; the cart drives it as soon as it has them."""
        self.offer(number)

    def finish_episode(self, number: int) -> Episode:
        """Wait for episode `number` to learn from."""
        return self._episode(self.config.evaluation_episodes + number)

    def log(self, scalars: Scalars, learned: int) -> None:
        """Keep curves for the next report."""
        self.actor.curves.append((learned, scalars))

    def save(self, learned: int) -> None:
        """Do nothing: the cart saves the weights that it gets, and the episodes are on its disk."""

    def _episode(self, number: int) -> Episode:
        return from_tensordict(self.connection.episode(number))
