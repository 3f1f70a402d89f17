"""Learning of a fine-tuning: from one cart's recordings, and from simulations that are fitted to them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.envs.build import environment, randomizer, simulated_env
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.identification.fit import Fit, best_fit
from cartpole_rl.identification.unknowns import LONGEST_LATENCY
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.learning.finetuning import Finetuning, recorded_chunk
from cartpole_rl.learning.settings import FinetuningSettings, LearningSettings
from cartpole_rl.learning.training import Scalars, Training
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetuning_files import pole_length
from cartpole_rl.workflows.person import print_message

SAMPLES = 4096  # carts drawn from each fit
EVALUATED_CARTS = 10  # of the score in simulation


class NoCallbacks:
    """A `learning.training.Monitor` that does nothing: the session logs by episodes on the cart."""

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Do nothing."""

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        """Do nothing."""

    def on_checkpoint(self, training: Training) -> None:
        """Do nothing."""


class CartLearner:
    """An agent that learns from the recordings of a cart and from simulations of it.

    `training` are the settings that the agent was trained with, `settings` those of the cart that it drives.
    `start` must be called before the agent can learn.
    """

    def __init__(
        self, config: FinetuneConfig, training: TrainConfig, settings: CartPoleSettings, agent: QAgent
    ) -> None:
        self.config, self.training, self.settings, self.agent = config, training, settings, agent
        models = training.models(training.plant)
        self.candidates = [models]  # physics models to fit
        if models.cart_friction is CartFriction.SIGMOID:
            self.candidates.append(models._replace(cart_friction=CartFriction.STEP))
        self.loop: Finetuning | None = None

    def start(
        self, recorded: Sequence[Episode], episodes: int, optimizer_state: dict[str, Any] | None
    ) -> None:
        """Fit the simulator to the `recorded` episodes and prepare learning.

        A resumed fine-tuning gives the number of `episodes` that it learned from, and its optimizer's state.
        """
        fit, models = self.fit_simulator(recorded)
        self.candidates = [models]
        self.loop = self.make_loop(fit, models)
        self.loop.iteration = episodes * self.config.finetuning.iterations
        for episode in recorded:
            self.add(episode)
        if optimizer_state is not None:
            self.loop.optimizer.load_state_dict(optimizer_state)
        self.loop.fill()

    @property
    def started(self) -> Finetuning:
        """The learning loop, once `start` has made it."""
        assert self.loop is not None
        return self.loop

    def round(self) -> Scalars:
        """Learn while one episode is driven. Returns curves for TensorBoard."""
        return self.started.round()

    def add(self, episode: Episode) -> None:
        """Learn from one more recorded episode from now on."""
        self.started.add(self.transitions(episode))

    def refit(self, recorded: Sequence[Episode]) -> None:
        """Fit the simulator to the `recorded` episodes, and continue with carts drawn from that fit."""
        fit, _ = self.fit_simulator(recorded)
        self.started.simulate(self.draws(fit))

    def make_loop(self, fit: Fit, models: Models) -> Finetuning:
        """Return the learning loop over carts drawn from `fit`."""
        config, training, finetuning = self.config, self.training, self.config.finetuning
        plant = SimulatedPlant(
            training.learning.carts,
            self.draws(fit),
            training.task.start,
            models,
            training.control_period,
            training.plant.substeps,
            config.seed,
            compiled=config.compile,
        )
        return Finetuning(
            finetuning,
            simulated_learning(training.learning, finetuning, config.episodes),
            training.buffer.model_copy(update={"kind": finetuning.buffer_kind}),
            training.optimizer.model_copy(update={"learning_rate": finetuning.learning_rate}),
            self.agent,
            environment(training, plant),
            lambda: [],
            NoCallbacks(),
            config.seed,
            config.compile,
        )

    def fit_simulator(self, recorded: Sequence[Episode]) -> tuple[Fit, Models]:
        """Return the fit with the lowest cost among the candidate models, and its models."""
        period = self.settings.control_period
        windows = cut_windows(recorded, period)
        nominal = {**self.training.nominal, **self.training.pole.nominal.model_dump()}
        fit, models = best_fit(windows, nominal, self.candidates, period)
        print_message(
            "finetune",
            f"simulator fitted to {windows.number} windows of {windows.periods * period:g} s: RMS error "
            f"{1e3 * CART_METRES_PER_COUNT * fit.rms[0]:.2f} mm and "
            f"{math.degrees(POLE_RADIANS_PER_COUNT) * fit.rms[1]:.2f} deg",
        )
        return fit, models

    def draws(self, fit: Fit) -> IdentifiedCarts:
        """Return what draws simulated carts: from `fit`, and a share as in training."""
        finetuning, random = self.config.finetuning, np.random.default_rng(self.config.seed)
        table = torch.from_numpy(fit.draw(SAMPLES, random, finetuning.widen)).float()
        return IdentifiedCarts(table, randomizer(self.training), finetuning.prior_share, LONGEST_LATENCY)

    def transitions(self, episode: Episode) -> Any:
        """Return an episode's transitions as the agent observes them; None where it has none."""

        def make_env(plant: RecordedPlant) -> CartPoleEnv:
            return environment(self.settings, plant)

        return recorded_chunk(episode, make_env, self.settings.actions.motors, pole_length(self.config))

    def simulated_score(self) -> float:
        """Return the agent's mean score on carts of its training, the same ones at every call."""
        training = self.training
        env = simulated_env(
            training,
            training.plant,
            EVALUATED_CARTS,
            training.task.evaluation_start,
            evaluation_seed(self.config.seed),
        )
        return float(np.mean([each.score.sum() for each in run_batch(env, self.agent.greedy_policy())]))


def simulated_learning(
    learning: LearningSettings, finetuning: FinetuningSettings, episodes: int
) -> LearningSettings:
    """Return the settings of the training loop for `episodes` rounds of a fine-tuning."""
    transitions = episodes * finetuning.iterations * learning.carts * learning.chunk
    return learning.model_copy(
        update={
            "transitions": transitions,
            "warmup_transitions": finetuning.warmup_transitions,
            "epsilon": finetuning.simulated_epsilon,
            "epsilon_transitions": max(1, int(finetuning.simulated_epsilon_share * transitions)),
        }
    )
