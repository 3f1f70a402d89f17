"""The learner's part of a fine-tuning, the same whether the cart is on this machine or on another."""

from collections.abc import Mapping
from typing import Any, Protocol

from cartpole_rl.learning.dqn import Scalars
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.finetuning_learner import CartLearner

SIMULATED_SCORE = "cart/score_in_simulation"  # TensorBoard's curve beside those of the cart


class TunedCart(Protocol):
    """A cart that drives the episodes to learn from, as the learner uses it."""

    def recorded(self, learned: int | None = None) -> list[Episode]:
        """Return the evaluation episodes and the first `learned` of those to learn from; None means all."""

    def start_episode(self, number: int) -> None:
        """Let the cart drive episode `number` with the agent's present weights, and return at once."""

    def finish_episode(self, number: int) -> Episode:
        """Wait for episode `number` to learn from, and return it."""

    def log(self, scalars: Scalars, learned: int) -> None:
        """Log curves after `learned` episodes."""

    def save(self, learned: int) -> None:
        """Save the state after `learned` episodes."""


def tune(cart: TunedCart, learner: CartLearner, learned: int, state: Mapping[str, Any] | None = None) -> None:
    """Learn while the cart drives, episode by episode, from `learned` episodes to all of them.

    `state` is that of an interrupted run; without it the simulator is fitted anew.
    """
    count, refit = learner.config.episodes, learner.config.finetuning.refit
    if learned >= count:
        return
    if state is None:
        learner.start(cart.recorded(learned), learned)
        cart.log({SIMULATED_SCORE: learner.simulated_score()}, learned)
    else:
        learner.restore(cart.recorded(learned), state)
    for number in range(learned, count):
        cart.start_episode(number)
        scalars = {**learner.round(), SIMULATED_SCORE: learner.simulated_score()}
        learner.add(cart.finish_episode(number))
        if (number + 1) % refit == 0 and number + 1 < count:
            learner.refit(cart.recorded())
        cart.log(scalars, number + 1)
        cart.save(number + 1)
