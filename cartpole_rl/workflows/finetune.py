"""Fine-tune a trained agent on the cart that it drives.

Three stages: episodes without exploration (before), episodes to learn from (tune), episodes without
exploration (after). A separate process drives the cart while this one learns. Each finished episode is on
disk before the next one starts: an interruption costs at most the current one.
"""

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from torch import nn

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.checking import checked
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.evaluation.driver import Driver
from cartpole_rl.evaluation.driving_policy import as_weights
from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.evaluation.publishing import followed
from cartpole_rl.evaluation.snapshots import Memory
from cartpole_rl.learning.checkpoints import (
    AgentCheckpoint,
    TrainingCheckpoint,
    forget_training,
    load_agent,
)
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.plants.serial.faults import Confirm
from cartpole_rl.reporting.scores import score_table
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.reporting.words import count_text
from cartpole_rl.run_files import CHECKPOINTS, COMPARISON, LAST, METRICS, RECORDINGS
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import new_agent, trained_agent
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings, is_real_time, use_threads
from cartpole_rl.workflows.checks import check_finetuning
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetuning_cart import DrivenCart, yielding_to
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_learner import CartLearner
from cartpole_rl.workflows.live import LiveView, view_title
from cartpole_rl.workflows.loading import recorded_settings
from cartpole_rl.workflows.person import confirm
from cartpole_rl.workflows.report import report
from cartpole_rl.workflows.results import plant_words, print_results, shown
from cartpole_rl.workflows.resuming import resumed
from cartpole_rl.workflows.run_folder import write_config, write_json

SIMULATED_SCORE = "cart/score_in_simulation"  # TensorBoard's curve beside those of the cart


def finetune(config: FinetuneConfig, folder: Path) -> None:
    """Fine-tune the agent of `config.run` on the cart of `config.plant`, or resume the run in `folder`.

    Writes config.yaml, provenance.json, recordings/, TensorBoard events, comparison.json (before and after),
    metrics.json, figures/ and checkpoints/last.pt with the better of both policies; until the end also
    checkpoints/resume.pt. Prints both scores. Raises ConfigError and CheckpointError before the cart moves,
    PlantError and LinkError for a cart that fails, LearningError if learning diverges.
    """
    checkpoint = resumed("finetune", config.resume, folder)
    if checkpoint:
        values = {**checkpoint.config, "resume": config.resume}
        config = recorded_settings(FinetuneConfig, values, f"resume={config.resume}")
    run = check_finetuning(config)
    use_threads(config.threads)
    seed_everything(config.seed)
    training = trained_agent(run).training
    evaluation = evaluation_config(config)
    settings = evaluated_settings(training, evaluation)
    files = FinetuningFiles(folder, config)
    write_config(folder, "finetune", config.model_dump(mode="json"), resumed=checkpoint is not None)
    if not checkpoint:
        files.save({}, 0)
    live = LiveView(view_title(config.plant), config.view)
    make_env = partial(driven_env, settings, evaluation, live.memory)  # called with `confirm`
    real_time = is_real_time(config.plant, config.emulator)
    with (
        live,
        TensorBoardLog(folder) as log,
        Driver(make_env, partial(greedy_network, training), real_time, confirm) as driver,
        yielding_to(driver) if real_time else nullcontext(),
    ):
        session = Session(files, DrivenCart(driver, files, log), load_agent(run), training, settings)
        if checkpoint and checkpoint.state:
            session.restore(checkpoint)
        session.run()


def driven_env(
    settings: CartPoleSettings, evaluation: EvaluateConfig, memory: Memory | None, confirm: Confirm
) -> CartPoleEnv:
    """Return the environment over the cart, in the process that drives it."""
    return followed(evaluated_env(settings, evaluation, print, confirm), memory)


def evaluation_config(config: FinetuneConfig) -> EvaluateConfig:
    """Return the settings that the cart is driven with."""
    shared = config.model_dump(include={"run", "plant", "emulator", "seed", "label", "threads"})
    episodes = config.evaluation_episodes
    return checked(EvaluateConfig, {**shared, "episodes": episodes, "randomization": {}, "parameters": None})


def greedy_network(training: TrainConfig) -> nn.Module:
    """Return the network that drives, for weights of `as_weights`."""
    return new_agent(training).greedy_policy()


class Session:
    """The stages of one fine-tuning of the agent `start`, on `cart`; `files` keep what is done."""

    def __init__(
        self,
        files: FinetuningFiles,
        cart: DrivenCart,
        start: AgentCheckpoint,
        training: TrainConfig,
        settings: CartPoleSettings,
    ) -> None:
        self.files, self.cart, self.start, self.settings = files, cart, start, settings
        self.config = files.config
        self.agent: QAgent = new_agent(training)
        self.agent.load_state_dict(start.weights)
        self.first_weights = as_weights(self.agent.greedy_policy())
        self.learner = CartLearner(self.config, training, settings, self.agent)
        self.num_learned = 0  # episodes of the stage TUNE
        self.learner_state: dict[str, Any] | None = None  # of a resumed run

    def run(self) -> None:
        """Run all stages, as far as they are not on disk."""
        count = self.config.evaluation_episodes
        self.cart.drive_missing(Stage.BEFORE, count, self.first_weights)
        self.tune()
        self.cart.drive_missing(Stage.AFTER, count, as_weights(self.agent.greedy_policy()))
        self.compare()
        forget_training(self.files.folder)

    def tune(self) -> None:
        """Drive and learn at the same time, episode by episode."""
        count, files = self.config.episodes, self.files
        if self.num_learned >= count:
            return
        recorded = files.episodes(Stage.BEFORE) + files.episodes(Stage.TUNE)[: self.num_learned]
        if self.learner_state is None:
            self.learner.start(recorded)
            self.log({SIMULATED_SCORE: self.learner.simulated_score()})
        else:
            self.learner.restore(recorded, self.learner_state)
        while self.num_learned < count:
            scalars = self.learn_from_next()
            if self.num_learned % self.config.finetuning.refit == 0 and self.num_learned < count:
                self.learner.refit(files.episodes(Stage.BEFORE) + files.episodes(Stage.TUNE))
            self.log(scalars)
            self.save()

    def learn_from_next(self) -> dict[str, float]:
        """Learn while the next episode is driven, unless it is on disk, and add it. Return curves to log."""
        number = self.num_learned
        driving = number >= self.files.count(Stage.TUNE)
        if driving:
            weights = as_weights(self.agent.greedy_policy())
            self.cart.start(weights, self.config.finetuning.epsilon, self.config.seed + number)
        scalars = {**self.learner.round(), SIMULATED_SCORE: self.learner.simulated_score()}
        if driving:
            self.cart.finish(Stage.TUNE, number)
        self.learner.add(self.files.episode(Stage.TUNE, number))
        self.num_learned += 1
        return scalars

    def log(self, scalars: dict[str, float]) -> None:
        """Log curves at the step of the last episode that was learned from."""
        self.cart.log.scalars(scalars, self.cart.step(Stage.TUNE, self.num_learned))

    def compare(self) -> None:
        """Keep the better policy, and write and print the results."""
        episodes = {stage: self.files.episodes(stage) for stage in (Stage.BEFORE, Stage.AFTER)}
        summaries = {stage: self.summarize(each) for stage, each in episodes.items()}
        scores = {stage: each["score"]["mean"] for stage, each in summaries.items()}
        kept = Stage.AFTER if scores[Stage.AFTER] >= scores[Stage.BEFORE] else Stage.BEFORE
        weights = self.agent.state_dict() if kept is Stage.AFTER else self.start.weights
        self.files.save_agent(
            AgentCheckpoint(self.start.config, weights, self.start.transitions, scores[kept])
        )
        folder, link = self.files.folder, self.cart.link_summary()
        x_max = self.settings.task.x_max
        report(folder, episodes[kept], self.config.plant.kind, self.settings.pole, x_max, link)
        write_json(folder / COMPARISON, {**summaries, "kept": kept})
        print(score_table(summaries[Stage.BEFORE], f"before, {count_text(len(episodes[Stage.BEFORE]))}"))
        print(score_table(summaries[Stage.AFTER], f"after, {count_text(len(episodes[Stage.AFTER]))}"))
        if link.get("latency_override"):
            print(f"latency as measured, for cartpole-train: '{link['latency_override']}'")
        print(f"kept: the policy {kept} fine-tuning")
        files = f"{METRICS}, {COMPARISON}, {CHECKPOINTS}/{LAST} and {RECORDINGS}/"
        print_results(
            folder, files, f"cartpole-evaluate run={shown(folder)} {plant_words(self.config.plant)}"
        )

    def summarize(self, episodes: list[Episode]) -> dict[str, Any]:
        """Return the metrics of `episodes` and their summary."""
        metrics = [episode_metrics(episode, self.settings.task.x_max) for episode in episodes]
        return {**summarize(metrics), "episodes": metrics}

    def save(self) -> None:
        """Write the checkpoint to resume from."""
        self.files.save(self.learner.snapshot(), self.num_learned)

    def restore(self, checkpoint: TrainingCheckpoint) -> None:
        """Continue from what `save` wrote."""
        self.num_learned, self.learner_state = checkpoint.step, checkpoint.state
        self.agent.load_state_dict(checkpoint.state["agent"])
