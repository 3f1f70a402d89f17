"""The callbacks of a training: progress bar, curves and pictures, history and checkpoints."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.evaluation.metrics import episode_metrics
from cartpole_rl.files import write_text
from cartpole_rl.learning.checkpoints import AgentCheckpoint, TrainingCheckpoint, save_agent, save_training
from cartpole_rl.learning.dqn import Monitor, Scalars, Training
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.reporting.animation import gif
from cartpole_rl.reporting.episodes import behaviour, columns
from cartpole_rl.reporting.loggers import Loggers
from cartpole_rl.reporting.web_view import WebView
from cartpole_rl.run_folder import BEST, CHECKPOINTS, HISTORY, LAST, file_hash
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import print_message, progress_bar
from cartpole_rl.workflows.config import TrainConfig

GUARDED = "guarded_fraction"  # None without a track guard
COMPARED = ("score", "score_upright", "steps", "time_to_upright_s", "upright_fraction", GUARDED)  # at the end
TAGS = {GUARDED: "track_guard_fraction"}  # of curves, which are sorted by name: the score comes first
AVERAGED = ("score", "score_upright", "steps", "upright_fraction")  # over the episodes of an evaluation
PICTURES = 4  # behaviour figures and animations, over the whole training


class TrainingMonitor(Monitor):
    """Monitor of one training in the run folder `folder`; a context manager around `Training.run`.

    `resumed_at` is the number of transitions from which a training is resumed: later records are removed.
    `view` shows the first episode of each evaluation.
    """

    def __init__(
        self, folder: Path, config: TrainConfig, resumed_at: int | None = None, view: WebView | None = None
    ) -> None:
        self.folder, self.config, self._view = folder, config, view
        self._settings = config.model_dump(mode="json")
        self._drawn_from = {str(path): file_hash(path) for path in config.drawn_from}
        self._logged = resumed_at or 0
        self._log = Loggers(config.logger, folder, None if resumed_at is None else resumed_at + 1)
        self._total = config.learning.at(config.control_period).collected_transitions
        self._bar = progress_bar(
            self._total, "transitions", initial=self._logged, unit_scale=True, mininterval=1.0
        )
        path = folder / HISTORY
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.history = [each for each in map(json.loads, lines) if each["transitions"] <= self._logged]
        self._write_history()

    def __enter__(self) -> "TrainingMonitor":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._bar.close()
        if error is not None:
            self._log.fail(error)
        self._log.close()

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Log curves and advance the progress bar."""
        self._log.scalars(scalars, transitions)
        self._advance(transitions)

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        """Log scores and sometimes pictures, and write the last and the best checkpoint."""
        transitions, record = training.transitions, self._record(training, episodes)
        self.history.append(record)
        self._write_history()
        curves = {TAGS.get(key, key): value for key, value in record.items() if key != "transitions"}
        self._log.scalars({f"evaluation/{key}": value for key, value in curves.items()}, transitions)
        if len(self.history) % max(1, self.config.learning.evaluations // PICTURES) == 0:
            self._log_pictures(episodes[0], transitions)
        score = record[self.config.task.measure]
        if self._view:
            name = f"{transitions / 1e6:.2f} M transitions: mean {self.config.task.measure} {score:z.0f}"
            self._view.add(columns(name, episodes[0], self.config.task.x_max))
        agent = AgentCheckpoint(self._settings, training.agent.state_dict(), transitions, score)
        for name in (LAST, BEST) if is_best else (LAST,):
            save_agent(self.folder / CHECKPOINTS / name, agent)
        scored = f"{self.config.task.measure} {score:z.0f}"
        self._bar.set_postfix_str(scored)
        self._advance(transitions)
        if self._bar.disable:
            done, total = transitions / 1e6, self._total / 1e6
            print_message("train", f"{done:.2f} of {total:.2f} M transitions, {scored}")

    def on_checkpoint(self, training: Training) -> None:
        """Write the state to resume from."""
        self._log.flush()
        state, step = training.snapshot(), training.transitions
        save_training(self.folder, TrainingCheckpoint(self._settings, state, step, self._drawn_from))

    def randomization(self, plant: SimulatedPlant) -> None:
        """Log histograms of the current parameters of all carts."""
        for name in (*self.config.ranges, "pole_length"):
            values = getattr(plant.parameters, name).cpu().numpy()
            self._log.histogram(f"randomization/{name}", values, self._logged)

    def finished(self, summary: Mapping[str, Any]) -> None:
        """Log the settings beside the means of the last evaluation."""
        metrics = {key: value["mean"] for key in COMPARED if (value := summary[key]) is not None}
        self._log.hparams(self._settings, metrics)

    def _advance(self, transitions: int) -> None:
        self._bar.update(transitions - self._logged)
        self._logged = transitions

    def _write_history(self) -> None:
        """Write the evaluations so far, a line each, all or none."""
        write_text(self.folder / HISTORY, "".join(json.dumps(record) + "\n" for record in self.history))

    def _record(self, training: Training, episodes: Sequence[Episode]) -> dict[str, float]:
        """Return the evaluation's line in the history."""
        metrics = [episode_metrics(episode, self.config.task.x_max) for episode in episodes]
        scores = [each[self.config.task.measure] for each in metrics]
        averaged = AVERAGED if metrics[0][GUARDED] is None else (*AVERAGED, GUARDED)
        means = {key: float(np.mean([each[key] for each in metrics])) for key in averaged}
        counts = {"transitions": training.transitions, "seconds": training.seconds}
        return {**counts, **means, "score_min": min(scores), "score_max": max(scores)}

    def _log_pictures(self, episode: Episode, transitions: int) -> None:
        half, length = self.config.task.x_max, self.config.pole.nominal.length
        title = f"After {transitions / 1e6:.1f} M transitions"
        self._log.figure("pictures/behaviour", behaviour(episode, title, half), transitions)
        self._log.animation("pictures/cart", gif(episode, length, half), transitions)
