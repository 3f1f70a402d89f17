"""The learner of learner=ray: an actor of Ray on another machine than the cart's.

The cart's machine calls `exchange` again and again: it gives episodes, and gets weights, curves and messages.
Weights carry a version, the number of episodes that had been learned from: version n drives episode n, as on
one machine. The learner outlives a lost connection, and ends when no cart asks for it any more.
"""

import os
import secrets
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from cartpole_rl.errors import CartPoleError, LearningError
from cartpole_rl.evaluation.driving_policy import Weights, as_weights
from cartpole_rl.learning.checkpoints import AgentCheckpoint, TrainingCheckpoint
from cartpole_rl.learning.dqn import Scalars
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import evaluated_settings, new_agent, use_threads
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig, recorded_settings
from cartpole_rl.workflows.finetuning_learner import CartLearner, TunedAgent, check_simulation

ABANDONED = 3600.0  # s without a call of `exchange`, after which the learner ends
POLL = 0.05  # s between two looks for an episode


@dataclass(frozen=True)
class LearnerTask:
    """All that a learner needs to start, or to continue from `newest`."""

    name: str  # of the run; the same after a resumption
    evaluation: Mapping[str, Any]  # settings of the driving
    start: AgentCheckpoint
    newest: TrainingCheckpoint  # settings of the fine-tuning, weights, and number of episodes learned from


class Offer(NamedTuple):
    """Weights of the whole agent that were learned from `version` episodes."""

    version: int
    weights: Weights


class Curves(NamedTuple):
    """Scalars for TensorBoard after `learned` episodes."""

    learned: int
    scalars: Scalars


class Taken(NamedTuple):
    """The first `total` news of the learner with the name `learner`: what the cart's machine has got."""

    learner: str = ""
    total: int = 0


News = Offer | Curves | str | LearningError  # str: a message; LearningError: learning has ended


class Learner:
    """Learns in a thread from its construction on. `exchange` is called at the same time."""

    def __init__(self, task: LearnerTask) -> None:
        self.task, self.name = task, secrets.token_hex(8)
        self.episodes: list[Episode] = []  # evaluations first
        self.news: list[News] = []
        self._asked = time.monotonic()
        for run in (self._learn, self._end_when_abandoned):
            threading.Thread(target=run, daemon=True).start()

    def exchange(
        self, taken: Taken, first: int, episodes: Sequence[Episode]
    ) -> tuple[Taken, list[News], int]:
        """Take `episodes`, which are numbered from `first`; return the news after those `taken`.

        Also returns what is taken with them, and the number of episodes that have arrived.
        """
        self._asked = time.monotonic()
        self.episodes += episodes[len(self.episodes) - first :]  # some may have come before
        start = taken.total if taken.learner == self.name else 0
        news = self.news[start:]
        return Taken(self.name, start + len(news)), news, len(self.episodes)

    def first(self, count: int) -> list[Episode]:
        """Wait for the first `count` episodes, and return them."""
        while len(self.episodes) < count:
            time.sleep(POLL)
        return self.episodes[:count]

    def _learn(self) -> None:
        try:
            self._tune()
        except CartPoleError as error:
            self.news.append(LearningError(f"the learner stopped: {error}"))
        except Exception as error:  # a defect; without this line it would be in a log file of Ray alone
            self.news.append(LearningError(f"the learner stopped: {type(error).__name__}: {error}"))

    def _tune(self) -> None:
        """Learn as `workflows.finetune.learn_here` does, with the same random numbers."""
        task, news = self.task, self.news
        config = recorded_settings(FinetuneConfig, task.newest.config, "the run")
        training = recorded_settings(TrainConfig, task.start.config, "the agent")
        evaluation = recorded_settings(EvaluateConfig, task.evaluation, "the run")
        check_simulation(training)
        use_threads(config.threads)
        seed_everything(config.seed)
        new_agent(training)  # as the one that `finetune` reads the settings of
        tuned = TunedAgent(training, task.start, task.newest)
        settings = evaluated_settings(training, evaluation)
        learner = CartLearner(config, training, settings, tuned.agent, news.append)
        before, learned = config.evaluation_episodes, tuned.learned
        news.append(Curves(learned, learner.start(self.first(before + learned), learned)))
        for number in range(learned, config.episodes):
            news.append(Offer(number, as_weights(tuned.agent)))
            curves = learner.round()
            learner.add(self.first(before + number + 1)[-1])
            news.append(Curves(number + 1, curves))
        news.append(Offer(config.episodes, as_weights(tuned.agent)))

    def _end_when_abandoned(self) -> None:
        while time.monotonic() - self._asked < ABANDONED:
            time.sleep(1)
        os._exit(0)
