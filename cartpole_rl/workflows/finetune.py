"""A trained agent learns on, on the cart that it drives.

Three stages: episodes without exploration (before), episodes to learn from (tune), episodes without
exploration (after). The cart is driven by a process of its own; this one learns meanwhile. Each finished
episode is on disk before the next begins, so that an interruption costs at most the one under way.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.evaluation.driver import Drive, Driver
from cartpole_rl.evaluation.driving_policy import as_weights
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.evaluation.recordings import LENGTH, read_recording, write_recording
from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.unknowns import LONGEST_LATENCY
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.learning.checkpoint_files import FOLDER, LAST
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    AgentCheckpoint,
    TrainingCheckpoint,
    forget_training,
    load_agent,
    save_agent,
    save_training,
)
from cartpole_rl.learning.finetuning import Finetuning, recorded_chunk
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.learning.training import Scalars, Training
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.plants.recorded import RecordedPlant
from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.found import FoundCarts
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.scheduling import give_precedence
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import (
    environment,
    evaluated_env,
    evaluated_settings,
    new_agent,
    randomizer,
    simulated_env,
    trained_agent,
    use_threads,
)
from cartpole_rl.workflows.checking import checked
from cartpole_rl.workflows.checks import check_finetuning
from cartpole_rl.workflows.config import (
    CartPoleSettings,
    EvaluateConfig,
    FinetuneConfig,
    RealSettings,
    TrainConfig,
)
from cartpole_rl.workflows.evaluate import score_table
from cartpole_rl.workflows.person import confirm, tell
from cartpole_rl.workflows.report import report
from cartpole_rl.workflows.resuming import resumed
from cartpole_rl.workflows.run_folder import METRICS, write_config, write_json

BEFORE, TUNE, AFTER = "before", "tune", "after"
RECORDINGS = "recordings"
DRAWN = 4096  # carts of each fit
SIMULATED_SCORE = "cart/score_in_simulation"  # TensorBoard's curve beside those of the cart
SIMULATED_CARTS = 10


def finetune(config: FinetuneConfig, folder: Path) -> None:
    """Drive and learn, compare, report; or go on with the fine-tuning in `folder`. Raises CartPoleError."""
    checkpoint = resumed("finetune", config.resume, folder)
    if checkpoint:
        config = checked(FinetuneConfig, {**checkpoint.config, "resume": config.resume})
    run = check_finetuning(config)
    use_threads(config.threads)
    seed_everything(config.seed)
    training = trained_agent(run).training
    evaluation = as_evaluation(config)
    settings = evaluated_settings(training, evaluation)
    if not checkpoint:
        write_config(folder, "finetune", config.model_dump(mode="json"))
        save_training(folder, TrainingCheckpoint(config.model_dump(mode="json"), {}, 0), FINETUNING_FORMAT)
    else:
        write_config(folder, "finetune", config.model_dump(mode="json"), resumed=True)
    make_env = partial(evaluated_env, settings, evaluation, print)  # takes who confirms, too
    real_time = config.plant.kind == "serial" or config.emulator.clock == "real"
    with (
        TensorBoardLog(folder) as log,
        Driver(make_env, partial(greedy_network, training), config.compile, real_time, confirm) as driver,
    ):
        if real_time:
            give_precedence()  # but not the process that drives, nor an emulated cart: those have begun
            if not driver.has_priority:
                tell(
                    "finetune", "other processes may delay the cart: no real-time priority (see `ulimit -r`)"
                )
        session = Session(config, training, settings, folder, driver, log)
        if checkpoint and checkpoint.state:
            session.restore(checkpoint.state)
        session.run()


def as_evaluation(config: FinetuneConfig) -> EvaluateConfig:
    """How the cart is driven."""
    shared = config.model_dump(include={"run", "plant", "emulator", "seed", "label", "threads"})
    episodes = config.evaluation_episodes
    return checked(EvaluateConfig, {**shared, "episodes": episodes, "randomization": {}, "parameters": None})


def greedy_network(training: TrainConfig) -> nn.Module:
    """The network that drives, for weights of `as_weights`."""
    return new_agent(training).greedy_policy()


def driven_length(config: FinetuneConfig) -> float | None:
    """m, the length of the pole on the cart that is driven; None where nobody has said it."""
    plant = config.plant
    return plant.pole_length if isinstance(plant, RealSettings) else 2 * config.emulator.pole_com


class Unheard:
    """A monitor of a training that is watched by its episodes."""

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Nobody looks."""

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        """There are no evaluations in simulation."""

    def on_checkpoint(self, training: Training) -> None:
        """The session writes its own."""


class Session:
    """One fine-tuning: what is on disk, what is learned, and what is driven next."""

    def __init__(
        self,
        config: FinetuneConfig,
        training: TrainConfig,
        settings: CartPoleSettings,
        folder: Path,
        driver: Driver,
        log: TensorBoardLog,
    ) -> None:
        assert config.run is not None
        self.config, self.training, self.settings = config, training, settings
        self.folder, self.driver, self.log = folder, driver, log
        self.start = load_agent(config.run)
        self.agent: QAgent = new_agent(training)
        self.agent.load_state_dict(self.start.weights)
        self.first_weights = as_weights(self.agent.greedy_policy())
        self.learner: Finetuning | None = None
        self.learned = 0  # episodes whose learning is done
        self.optimizer_state: dict[str, Any] | None = None  # of a run that is resumed
        self.models = [training.models(training.plant)]
        if self.models[0].cart_friction is CartFriction.SIGMOID:
            self.models.append(self.models[0]._replace(cart_friction=CartFriction.STEP))
        self.link: LinkStatistics | None = None  # of the newest episode's process

    def run(self) -> None:
        """All stages, from where the disk says that they stand."""
        config = self.config
        self.drive_all(BEFORE, config.evaluation_episodes)
        self.tune()
        before = summarize([self.figures(episode) for episode in self.episodes(BEFORE)])
        self.drive_all(AFTER, config.evaluation_episodes)
        after_episodes = self.episodes(AFTER)
        after = summarize([self.figures(episode) for episode in after_episodes])
        better = after["score"]["mean"] >= before["score"]["mean"]
        self.keep(better, after if better else before)
        shown = after_episodes if better else self.episodes(BEFORE)
        link = {} if self.link is None else self.link_figures(self.link)
        plant, x_max = config.plant.kind, self.settings.task.x_max
        report(self.folder, shown, plant, self.settings.pole, x_max, link)
        kept = AFTER if better else BEFORE
        write_json(self.folder / "comparison.json", {BEFORE: before, AFTER: after, "kept": kept})
        forget_training(self.folder)
        print(score_table(before, f"before, {config.evaluation_episodes} episodes"))
        print(score_table(after, f"after {config.episodes} episodes of learning"))
        if link.get("latency_override"):
            print(f"latency as measured, for cartpole-train: '{link['latency_override']}'")
        print(
            f"kept: the policy {kept} fine-tuning; "
            f"{self.folder}/{METRICS}, checkpoints/{LAST}, recordings/ are written"
        )

    def tune(self) -> None:
        """Drive and learn at once, episode by episode."""
        count = self.config.episodes
        if self.learned >= count:
            return
        self.begin_learning()
        assert self.learner is not None
        if not self.learned:
            self.log.scalars({SIMULATED_SCORE: self.simulated_score()}, self.step(TUNE, 0))
        while self.learned < count:
            number = self.learned
            driving = number >= len(self.episodes(TUNE))
            if driving:
                weights = as_weights(self.agent.greedy_policy())
                self.driver.start(Drive(weights, self.config.finetuning.epsilon, self.config.seed + number))
            scalars = {**self.learner.round(), SIMULATED_SCORE: self.simulated_score()}
            if driving:
                self.finish(TUNE, number)
            episode = self.episodes(TUNE)[number]
            self.learner.add(self.chunk(episode))
            self.learned += 1
            if self.learned % self.config.finetuning.refit == 0 and self.learned < count:
                self.refit()
            self.log.scalars(scalars, self.step(TUNE, self.learned))
            self.save()

    def begin_learning(self) -> None:
        """Build the learner on the first fit; after a resumption, on all that was recorded."""
        recorded = self.episodes(BEFORE) + self.episodes(TUNE)[: self.learned]
        fit, models = self.best_fit(recorded)
        training, finetuning = self.training, self.config.finetuning
        learning = training.learning
        iterations = self.config.episodes * finetuning.iterations
        plant = SimulatedPlant(
            learning.carts,
            self.carts(fit),
            training.task.start,
            models,
            training.control_period,
            training.plant.substeps,
            self.config.seed,
            compiled=self.config.compile,
        )
        learner = Finetuning(
            finetuning,
            learning.model_copy(
                update={
                    "transitions": iterations * learning.carts * learning.chunk,
                    "warmup_transitions": 0,
                    "epsilon": (0.1, 0.02),
                    "epsilon_transitions": iterations * learning.carts * learning.chunk // 2,
                }
            ),
            training.buffer.model_copy(update={"kind": "uniform"}),
            training.optimizer.model_copy(update={"learning_rate": finetuning.learning_rate}),
            self.agent,
            environment(training, plant),
            lambda: [],
            Unheard(),
            self.config.seed,
            self.config.compile,
        )
        learner.iteration = self.learned * finetuning.iterations
        for episode in recorded:
            learner.add(self.chunk(episode))
        if self.optimizer_state is not None:
            learner.optimizer.load_state_dict(self.optimizer_state)
        learner.fill()
        self.models, self.learner = [models], learner

    def refit(self) -> None:
        """Fit anew to all recordings, and go on with carts of that fit."""
        assert self.learner is not None
        fit, _ = self.best_fit(self.episodes(BEFORE) + self.episodes(TUNE))
        self.learner.simulate(self.carts(fit))

    def best_fit(self, episodes: list[Episode]) -> tuple[Fit, Models]:
        """The fit, and the laws of those tried under which it is best."""
        windows = cut_windows(episodes, self.settings.control_period)
        nominal = {**self.training.nominal, **self.training.pole.nominal.model_dump()}
        fits = [
            (fit_cart(windows, nominal, models, self.settings.control_period), models)
            for models in self.models
        ]
        fit, models = min(fits, key=lambda each: each[0].cost)
        tell(
            "finetune",
            f"the simulator follows {windows.number} recorded half seconds within "
            f"{fit.rms[0] * 0.022749:.2f} mm and {fit.rms[1] * 0.0879:.2f} deg",
        )
        return fit, models

    def carts(self, fit: Fit) -> FoundCarts:
        """Carts of the fit, and some as in training."""
        random = np.random.default_rng(self.config.seed)
        table = torch.from_numpy(fit.draw(DRAWN, random, self.config.finetuning.widen)).float()
        prior_share = self.config.finetuning.prior_share
        return FoundCarts(table, randomizer(self.training), prior_share, LONGEST_LATENCY)

    def drive_all(self, stage: str, count: int) -> None:
        """Drive what is missing of a stage, without exploration."""
        weights = self.first_weights if stage == BEFORE else as_weights(self.agent.greedy_policy())
        for number in range(len(self.episodes(stage)), count):
            self.driver.start(Drive(weights, 0.0, self.config.seed))
            self.finish(stage, number)

    def finish(self, stage: str, number: int) -> None:
        """Wait for an episode, and write it down."""
        driven = self.driver.result()
        self.link = driven.link
        if driven.episode.ended_by == Ending.NON_FINITE:
            raise LearningError(
                f"{stage} {number + 1}: an observation or an action value was not finite, so the cart was "
                "stopped; nothing is learned from this episode"
            )
        length = driven_length(self.config)
        facts = {"stage": stage, "number": number, LENGTH: "" if length is None else f"{length:.4f}"}
        write_recording(self.path(stage, number), driven.episode, facts)
        figures = self.figures(driven.episode)
        step = self.step(stage, number + 1)
        self.log.scalars({f"cart/score_{stage}": figures["score"]}, step)
        self.log.scalars(
            {f"link/{key}": float(value) for key, value in vars(self.link.summary()).items()}, step
        )
        self.log.flush()
        tqdm.write(f"{stage} {number + 1}: score {figures['score']:.0f}, ended by {driven.episode.ended_by}")

    def step(self, stage: str, number: int) -> int:
        """TensorBoard's step of a stage's `number`th episode, from 1: all stages in one row."""
        config = self.config
        ahead = {
            BEFORE: 0,
            TUNE: config.evaluation_episodes,
            AFTER: config.evaluation_episodes + config.episodes,
        }
        return ahead[stage] + number

    def simulated_score(self) -> float:
        """Mean score of the agent as it is now, on the same carts of its training's simulation each time."""
        training = self.training
        start = training.task.evaluation_start
        env = simulated_env(
            training, training.plant, SIMULATED_CARTS, start, evaluation_seed(self.config.seed)
        )
        return float(np.mean([each.score.sum() for each in run_batch(env, self.agent.greedy_policy())]))

    def path(self, stage: str, number: int) -> Path:
        """Where an episode is kept."""
        return self.folder / RECORDINGS / f"{stage}_{number:03d}.csv"

    def episodes(self, stage: str) -> list[Episode]:
        """What is on disk of a stage, in order."""
        found: list[Episode] = []
        while (path := self.path(stage, len(found))).exists():
            found.append(read_recording(path))
        return found

    def figures(self, episode: Episode) -> dict[str, Any]:
        """What an episode is worth."""
        return episode_metrics(episode, self.settings.task.x_max)

    def chunk(self, episode: Episode) -> Any:
        """An episode's transitions, as the agent sees them."""

        def over(plant: RecordedPlant) -> CartPoleEnv:
            return environment(self.settings, plant)

        return recorded_chunk(episode, over, self.settings.actions.motors, driven_length(self.config))

    def save(self) -> None:
        """The state to resume from."""
        assert self.learner is not None
        state = {
            "learned": self.learned,
            "agent": self.agent.state_dict(),
            "optimizer": self.learner.optimizer.state_dict(),
        }
        checkpoint = TrainingCheckpoint(self.config.model_dump(mode="json"), state, self.learned)
        save_training(self.folder, checkpoint, FINETUNING_FORMAT)

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `save`."""
        self.learned = state["learned"]
        self.agent.load_state_dict(state["agent"])
        self.optimizer_state = state["optimizer"]

    def keep(self, tuned: bool, summary: dict[str, Any]) -> None:
        """Write the better policy as the run's last checkpoint."""
        weights = self.agent.state_dict() if tuned else self.start.weights
        score = summary["score"]["mean"]
        checkpoint = AgentCheckpoint(self.start.config, weights, self.start.transitions, score)
        save_agent(self.folder / FOLDER / LAST, checkpoint)

    @staticmethod
    def link_figures(link: LinkStatistics) -> dict[str, Any]:
        """Frames lost, spoilt and late on the wire, and the time from a state to its command."""
        return {**vars(link.summary()), "latency_override": link.latency_override()}
