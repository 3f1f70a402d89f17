"""Learning of a fine-tuning: from one cart's recordings, and from simulations that are fitted to them.

The simulator is fitted to all recordings; carts are drawn from the uncertainty of the fit. Training then
continues on both, with the same loop and the same loss.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import driven_carts, environment, simulated_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import CheckpointError, ConfigError, RecordingError
from cartpole_rl.evaluation.driving_policy import Weights, as_weights
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.identification.fit import best_fit
from cartpole_rl.identification.unknowns import LONGEST_LATENCY
from cartpole_rl.identification.windows import NoWindowError, cut_windows
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import (
    AgentCheckpoint,
    TrainingCheckpoint,
    check_finite,
    restore_weights,
    whole_state,
)
from cartpole_rl.learning.dqn import COLLECTED, Monitor, Scalars, Training, n_step_transitions
from cartpole_rl.learning.settings import BufferSettings, FinetuningSettings, LearningSettings
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.terminal import print_message
from cartpole_rl.workflows.build import known_poles, new_agent
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetuning_cart import Stage
from cartpole_rl.workflows.poles import guard_holds

PRINT = partial(print_message, "finetune")
SAMPLES = 4096  # carts drawn from each fit
EVALUATED_CARTS = 10  # of the score in simulation
FEW = 0.05  # share of an episode's steps: it is not said that so few are left out
SIMULATED_SCORE = "cart/score_in_simulation"  # TensorBoard's curve beside those of the cart


def recorded_chunks(
    episode: Episode,
    make_env: Callable[[RecordedPlant], CartPoleEnv],
    motors: Sequence[int],
    pole_length: float | None,
    hardware: Hardware | None = None,
) -> list[TensorDictBase]:
    """Return the one-step transitions of an episode in the environment that `make_env` builds.

    `pole_length` m is that of the cart, None if it is not known; `hardware` is the cart's, ip02's if it is
    not given. The last step before a lost link is left out, since its outcome was not measured. So are the
    steps that no action of the agent drove, such as those of the firmware's brake or of a late value, and
    those at whose end a frame came late or was lost: they part the episode into chunks [1, T].
    """
    env = make_env(RecordedPlant(episode, pole_length, hardware))
    index = {motor: action for action, motor in enumerate(motors)}
    current = env.reset()
    parts: list[list[TensorDictBase]] = [[]]
    regular = episode.regular_frames(float(np.median(np.diff(episode.time))) if episode.steps else 1.0)
    motor_values = episode.motor[: episode.measured_steps].tolist()
    for row, (motor, in_time) in enumerate(zip(motor_values, regular, strict=False), start=1):
        current["action"] = torch.tensor([index.get(motor, 0)])
        transition, current = env.step_and_maybe_reset(current)
        if row == episode.steps and episode.ended_by == Ending.ANGLE:
            # that holds: in other arithmetic, a pole right at its limit has not fallen
            transition["next", "terminated"].fill_(True)
            transition["next", "done"].fill_(True)
        if in_time and motor in index:
            parts[-1].append(transition.select(*COLLECTED))
        else:
            parts.append([])
    return [torch.stack(part, 1) for part in parts if part]


class Finetuning(Training):
    """A training of a trained agent, on simulated carts of a fit and on recordings of a cart."""

    rate_setting = "finetuning.learning_rate"

    def __init__(self, finetuning: FinetuningSettings, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.finetuning = finetuning
        self.recorded: TensorDictBase | None = None
        self._chooser = torch.Generator().manual_seed(self.seed)

    def add(self, chunks: Sequence[TensorDictBase]) -> None:
        """Add the chunks of a recorded episode."""
        for chunk in chunks:
            transitions = n_step_transitions(chunk, self.settings.steps, self.agent.settings.discount)
            earlier = self.recorded
            self.recorded = transitions if earlier is None else torch.cat((earlier, transitions))

    def simulate(self, carts: Draws) -> None:
        """Continue on simulated carts drawn from `carts`; the transitions of older ones are discarded."""
        self.env.plant.replace_randomizer(carts)
        self.start_episodes()
        self.buffer.empty()
        self.fill()

    def fill(self) -> None:
        """Collect a whole episode of each simulated cart, so that the buffer holds all parts of it."""
        for _ in range(self.env.hardware.task.periods // self.settings.chunk):
            self.collect()

    def round(self) -> Scalars:
        """Run the iterations that belong to one episode of the cart."""
        scalars: Scalars = {}
        for _ in range(self.finetuning.iterations):
            chunk, scalars = self.iterate()
            scalars |= self.describe(chunk)
        return scalars

    def sample(self) -> TensorDictBase:
        """Return simulated transitions, a random `cart_share` of them replaced by recorded ones."""
        simulated = self.buffer.sample()
        if self.recorded is None or self.finetuning.cart_share == 0:
            return simulated
        count = len(simulated)
        places = torch.rand(count, generator=self._chooser) < self.finetuning.cart_share
        which = torch.randint(len(self.recorded), (int(places.sum()),), generator=self._chooser)
        mixed = simulated.select(*self.recorded.keys(True, True)).clone()
        mixed[places] = self.recorded[which]
        return mixed

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the training, without the recorded transitions."""
        return {**super().snapshot(), "chooser": self._chooser.get_state()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`."""
        super().restore(snapshot)
        self._chooser.set_state(snapshot["chooser"])


class TunedAgent:
    """The agent `start` and the one that it becomes, after `learned` episodes of its cart.

    An interrupted run continues from `checkpoint`, whose `state` may hold the agent's weights alone.
    """

    def __init__(
        self, training: TrainConfig, start: AgentCheckpoint, checkpoint: TrainingCheckpoint | None
    ) -> None:
        self.training, self.start = training, start
        self.agent: QAgent = new_agent(training)
        self.agent.load_state_dict(start.weights)
        self.first_weights = self.weights
        self.learned, self.logged = 0, -1  # episodes; up to `logged`, the run has the curves
        self.state: dict[str, Any] = {}
        if checkpoint and checkpoint.state:
            self.learned, self.state = checkpoint.step, checkpoint.state
            self.logged = self.learned or -1
            restore_weights(self.agent, self.state.get("agent", {}), "the state to resume from")

    @property
    def weights(self) -> Weights:
        """A copy of the present weights that drive."""
        return as_weights(self.agent.greedy_policy())

    def replace(self, weights: Weights, source: str) -> None:
        """Replace the present weights. Raises CheckpointError for others than finite ones of this network."""
        kinds, own = (
            {name: (weight.shape, weight.dtype) for name, weight in each.items()}
            for each in (weights, as_weights(self.agent))
        )
        if kinds != own:
            raise CheckpointError(f"{source} are refused: they are of another network")
        state = {name: torch.tensor(weight) for name, weight in weights.items()}
        check_finite(state, f"{source} are refused")
        self.agent.load_state_dict(state)

    def checkpoint(self, kept: Stage, score: float, driven: PoleSettings) -> AgentCheckpoint:
        """Return the agent before or after its fine-tuning on a cart with the pole `driven`."""
        if kept is Stage.BEFORE:
            return replace(self.start, score=score)
        poles = self.start.tuned_poles
        if not any(guard_holds(each, driven) for each in known_poles(self.training, self.start)):
            poles = [*poles, driven.model_dump(mode="json")]
        return replace(self.start, weights=self.agent.state_dict(), score=score, tuned_poles=poles)


class CartLearner:
    """An agent that learns from the recordings of a cart and from simulations of it.

    `training` are the settings that the agent was trained with, `settings` those of the cart that it drives.
    `show` prints a message. `start` or `restore` makes `loop`, and must be called before the agent can learn.
    """

    loop: Finetuning
    models: Models  # of the simulated carts
    carts: torch.Tensor  # [P, SAMPLES], drawn from the newest fit, or as in training
    recorded: list[Episode]  # evaluations first
    is_fitted = True  # the simulator, to recordings of this cart

    def __init__(
        self,
        config: FinetuneConfig,
        training: TrainConfig,
        settings: CartPoleSettings,
        agent: QAgent,
        show: Callable[[str], None] = PRINT,
    ) -> None:
        self.config, self.training, self.settings, self.agent = config, training, settings, agent
        self.show = show
        self.trained_carts, models = driven_carts(training, training.plant)
        self.candidates = [models]  # physics models to fit; those of the first fit alone, once there is one
        if models.cart_friction == "sigmoid":
            self.candidates.append(models._replace(cart_friction=CART_FRICTIONS.find("step")))

    def start(self, recorded: Sequence[Episode], learned: int = 0) -> Scalars:
        """Fit the simulator to the `recorded` episodes and prepare learning; return the first curves.

        The agent has learned from `learned` episodes already: the schedules continue there. While every
        episode is too short for a fit, carts are drawn as in training. Raises RecordingError.
        """
        try:
            models = self.fit_simulator(recorded)
        except NoWindowError as error:
            self.is_fitted = False
            self.show(f"the simulator is not fitted yet, its carts are drawn as in training: {error}")
            models, random = self.candidates[0], torch.Generator().manual_seed(self.config.seed)
            self.carts = self.trained_carts.draw(SAMPLES, random)
        self.prepare(recorded, models)
        self.loop.iteration = learned * self.config.finetuning.iterations
        self.loop.fill()
        return {SIMULATED_SCORE: self.simulated_score()}

    def restore(self, recorded: Sequence[Episode], snapshot: Mapping[str, Any]) -> None:
        """Continue from `snapshot`; `recorded` are the episodes that were learned from until then."""
        with whole_state(f"resume={self.config.resume}"):
            self.carts = snapshot["carts"]
            self.is_fitted = snapshot.get("is_fitted", True)  # missing in earlier versions
            friction = CART_FRICTIONS.find(snapshot["cart_friction"])
            models = self.candidates[0]._replace(cart_friction=friction)
            if self.is_fitted:
                self.candidates = [models]
            self.prepare(recorded, models)
            self.loop.restore(snapshot)

    def snapshot(self) -> dict[str, Any]:
        """Return the state from which `restore` continues, to be saved at once."""
        state = {
            "carts": self.carts,
            "cart_friction": str(self.models.cart_friction),
            "is_fitted": self.is_fitted,
        }
        return {**self.loop.snapshot(), **state}

    def round(self) -> Scalars:
        """Learn while one episode is driven; return curves."""
        return {**self.loop.round(), SIMULATED_SCORE: self.simulated_score()}

    def add(self, episode: Episode) -> None:
        """Learn from one more recorded episode from now on, and fit the simulator anew when it is time."""
        self.recorded.append(episode)
        self.loop.add(self.transitions(episode))
        learned = len(self.recorded) - self.config.evaluation_episodes
        is_due = learned % self.config.finetuning.refit == 0 or not self.is_fitted
        if is_due and learned < self.config.episodes:
            self.refit()

    def refit(self) -> None:
        """Fit the simulator to all recorded episodes, and continue with carts drawn from that fit.

        An episode that no cart drives, as with a loose encoder, leaves the earlier fit.
        """
        try:
            models = self.fit_simulator(self.recorded)
        except RecordingError as error:
            self.show(f"the simulator stays as it is: {error}")
            return
        self.is_fitted = True
        if models == self.models:
            self.loop.simulate(self.randomizer())
            return
        iteration = self.loop.iteration
        self.prepare(self.recorded, models)
        self.loop.iteration = iteration
        self.loop.fill()

    def prepare(self, recorded: Sequence[Episode], models: Models) -> None:
        """Make the learning loop for `models`, with the transitions of the `recorded` episodes."""
        self.models, self.recorded = models, list(recorded)
        self.loop = self.make_loop(models)
        for episode in recorded:
            self.loop.add(self.transitions(episode))

    def make_loop(self, models: Models) -> Finetuning:
        """Return the learning loop over simulated carts."""
        config, training, finetuning = self.config, self.training, self.config.finetuning
        guarded = training.model_copy(update={"guard": self.settings.guard})  # as the cart
        plant = SimulatedPlant(
            training.learning.carts,
            self.randomizer(),
            training.task.start,
            models,
            training.control_period,
            training.plant.substeps,
            config.seed,
            compiled=config.compile,
            hardware=training.hardware,
        )
        return Finetuning(
            finetuning,
            simulated_learning(training.learning.at(training.control_period), finetuning, config.episodes),
            simulated_buffer(training.buffer, finetuning),
            training.optimizer.model_copy(update={"learning_rate": finetuning.learning_rate}),
            self.agent,
            environment(guarded, plant),
            lambda: [],
            Monitor(),
            config.seed,
            config.compile,
        )

    def fit_simulator(self, recorded: Sequence[Episode]) -> Models:
        """Draw carts from the fit with the lowest cost; return its models, which stay the only candidates."""
        period = self.settings.control_period
        windows = cut_windows(recorded, period)
        poles = self.training.pole if self.config.plant.reads_emulator else self.settings.pole
        fit, models = best_fit(windows, self.training.nominal_with(poles.nominal), self.candidates, period)
        self.show(
            f"simulator fitted to {windows.number} windows of {windows.periods * period:g} s: typical error "
            f"{1e3 * fit.spread[0]:.2f} mm and {math.degrees(fit.spread[1]):.2f} deg"
        )
        self.candidates = [models]
        random = np.random.default_rng(self.config.seed)
        self.carts = torch.from_numpy(fit.draw(SAMPLES, random, self.config.finetuning.widen)).float()
        return models

    def randomizer(self) -> IdentifiedCarts:
        """Return the randomizer of the simulated carts: of the newest fit, and a share of the prior."""
        share = self.config.finetuning.prior_share
        return IdentifiedCarts(self.carts, self.trained_carts, share, LONGEST_LATENCY)

    def transitions(self, episode: Episode) -> list[Any]:
        """Return an episode's transitions in chunks, as the agent observes them."""
        motors = self.settings.actions.motors
        length = self.config.plant.known_pole_length(self.config.emulator)
        make_env, hardware = partial(environment, self.settings), self.settings.hardware
        chunks = recorded_chunks(episode, make_env, motors, length, hardware)
        learned, measured = sum(chunk.shape[1] for chunk in chunks), episode.measured_steps
        if learned < (1 - FEW) * measured:
            self.show(
                f"{measured - learned} of {measured} steps of an episode are not learned from: the cart's own"
                " brake or a late command drove them, or their frame was late or lost"
            )
        return chunks

    def simulated_score(self) -> float:
        """Return the agent's mean score on carts of its training, the same ones at every call."""
        training, measure = self.training, self.settings.task.measure
        start, seed = training.task.evaluation_start, evaluation_seed(self.config.seed)
        env = simulated_env(training, training.plant, EVALUATED_CARTS, start, seed)
        return float(np.mean([each.total(measure) for each in run_batch(env, self.agent.greedy_policy())]))


def check_warmup(config: FinetuneConfig, training: TrainConfig) -> None:
    """Raise ConfigError for a fine-tuning that would learn nothing."""
    learning = training.learning.at(training.control_period)
    warmup = config.finetuning.warmup_transitions
    simulated = simulated_learning(learning, config.finetuning, config.episodes).collected_transitions
    if warmup >= simulated:
        raise ConfigError(
            f"finetuning.warmup_transitions={warmup}: nothing would be learned, as this run simulates "
            f"{simulated} transitions after it has filled the buffer; give fewer, or more episodes"
        )


def check_simulation(training: TrainConfig) -> None:
    """Raise CartPoleError if a file that the simulation of the training reads is missing or damaged."""
    simulated_env(training, training.plant, 1, training.task.start, training.seed)


def simulated_buffer(buffer: BufferSettings, finetuning: FinetuningSettings) -> BufferSettings:
    """Return the settings of the buffer of a fine-tuning: those of the training, with the kind chosen for it.

    Priorities that a training without them leaves at alpha 0 are those of conf/buffer/prioritized.yaml.
    """
    if finetuning.buffer_kind == "uniform" or buffer.alpha > 0:
        return buffer.model_copy(update={"kind": finetuning.buffer_kind})
    return BufferSettings(**{**choice("buffer/prioritized"), "size": buffer.size})


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
