"""The stages of a fine-tuning, and the session whose learner is this process."""

from dataclasses import replace
from typing import Any

from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.evaluation.driving_policy import Weights, as_weights
from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import AgentCheckpoint, TrainingCheckpoint, restore_weights
from cartpole_rl.learning.dqn import Scalars
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.scores import SCORES, score_table
from cartpole_rl.reporting.words import count_text, cut_off
from cartpole_rl.run_files import CHECKPOINTS, COMPARISON, LAST, METRICS, RECORDINGS
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import known_poles, new_agent
from cartpole_rl.workflows.config import TrainConfig
from cartpole_rl.workflows.finetuning_cart import DrivenCart
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_learner import CartLearner
from cartpole_rl.workflows.person import as_word
from cartpole_rl.workflows.report import report
from cartpole_rl.workflows.results import plant_words, print_loop_time, print_results, shown
from cartpole_rl.workflows.run_folder import write_json
from cartpole_rl.workflows.trained_poles import guard_holds
from cartpole_rl.workflows.tuning import tune


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
        self.learned = 0
        self.state: dict[str, Any] = {}
        if checkpoint and checkpoint.state:
            self.learned, self.state = checkpoint.step, checkpoint.state
            restore_weights(self.agent, self.state.get("agent", {}), "the state to resume from")

    @property
    def weights(self) -> Weights:
        """A copy of the present weights that drive."""
        return as_weights(self.agent.greedy_policy())

    def checkpoint(self, kept: Stage, score: float, driven: PoleSettings) -> AgentCheckpoint:
        """Return the agent before or after its fine-tuning on a cart with the pole `driven`."""
        if kept is Stage.BEFORE:
            return replace(self.start, score=score)
        poles = self.start.tuned_poles
        if not any(guard_holds(each, driven) for each in known_poles(self.training, self.start)):
            poles = [*poles, driven.model_dump(mode="json")]
        return replace(self.start, weights=self.agent.state_dict(), score=score, tuned_poles=poles)


class Session:
    """The stages of one fine-tuning of `tuned` on `cart`; `files` keep what is done."""

    def __init__(
        self, files: FinetuningFiles, cart: DrivenCart, tuned: TunedAgent, settings: CartPoleSettings
    ) -> None:
        self.files, self.cart, self.tuned = files, cart, tuned
        self.config, self.settings = files.config, settings

    def run(self) -> None:
        """Run all stages, as far as they are not on disk."""
        self.cart.evaluate(Stage.BEFORE, self.tuned.first_weights)
        self.tune()
        self.cart.evaluate(Stage.AFTER, self.tuned.weights)
        self.compare()
        self.files.forget_training()

    def tune(self) -> None:
        """Drive the episodes to learn from, and let the agent learn from them."""
        raise NotImplementedError

    def compare(self) -> None:
        """Keep the better policy, and write and print the results."""
        episodes = {stage: self.files.episodes(stage) for stage in (Stage.BEFORE, Stage.AFTER)}
        summaries = {stage: self.summarize(each) for stage, each in episodes.items()}
        measure = self.settings.task.measure
        scores = {stage: each[measure]["mean"] for stage, each in summaries.items()}
        kept = Stage.AFTER if scores[Stage.AFTER] >= scores[Stage.BEFORE] else Stage.BEFORE
        self.files.save_agent(self.tuned.checkpoint(kept, scores[kept], self.settings.pole))
        folder, link = self.files.folder, self.cart.link_summary()
        report(folder, episodes[kept], self.config.plant.kind, self.settings.pole, self.settings.task, link)
        write_json(folder / COMPARISON, {**summaries, "kept": kept})
        print(score_table(summaries[Stage.BEFORE], f"before, {count_text(len(episodes[Stage.BEFORE]))}"))
        print(score_table(summaries[Stage.AFTER], f"after, {count_text(len(episodes[Stage.AFTER]))}"))
        for line in cut_off([*episodes[Stage.BEFORE], *episodes[Stage.AFTER]]):
            print(line)
        print_loop_time(link.get("latency_override"))
        print(f"kept: the policy {kept} fine-tuning, by its {SCORES[measure]}")
        files = f"{METRICS}, {COMPARISON}, {CHECKPOINTS}/{LAST} and {RECORDINGS}/"
        cart = plant_words(self.config.plant, [self.settings.pole])
        print_results(folder, files, f"cartpole-evaluate {as_word('run', shown(folder))} {cart}")

    def summarize(self, episodes: list[Episode]) -> dict[str, Any]:
        """Return the metrics of `episodes` and their summary."""
        metrics = [episode_metrics(episode, self.settings.task.x_max) for episode in episodes]
        return {**summarize(metrics), "episodes": metrics}


class LocalSession(Session):
    """A session whose learner is this process."""

    def tune(self) -> None:
        """Drive and learn at the same time, episode by episode."""
        tuned = self.tuned
        self.learner = CartLearner(self.config, tuned.training, self.settings, tuned.agent)
        is_whole = "replay" in tuned.state  # not that of a learner on another machine
        tune(self, self.learner, tuned.learned, tuned.state if is_whole else None)

    def recorded(self, learned: int | None = None) -> list[Episode]:
        """Return the evaluation episodes and the first `learned` of those to learn from; None means all."""
        return self.files.episodes(Stage.BEFORE) + self.files.episodes(Stage.TUNE)[:learned]

    def start_episode(self, number: int) -> None:
        """Start episode `number` to learn from, unless it is on disk."""
        self.driving = number >= self.files.count(Stage.TUNE)
        if self.driving:
            self.cart.start(self.tuned.weights, self.config.finetuning.epsilon, self.config.seed + number)

    def finish_episode(self, number: int) -> Episode:
        """Wait until episode `number` to learn from is on disk, and return it."""
        if self.driving:
            self.cart.finish(Stage.TUNE, number)
        return self.files.episode(Stage.TUNE, number)

    def log(self, scalars: Scalars, learned: int) -> None:
        """Log curves at the step of the last episode that was learned from."""
        self.cart.log.scalars(scalars, self.cart.step(Stage.TUNE, learned))

    def save(self, learned: int) -> None:
        """Write the checkpoint to resume from."""
        self.files.save(self.learner.snapshot(), learned)
