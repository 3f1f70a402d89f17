"""What is seen of a training while it runs and afterwards: progress bar, TensorBoard, history, checkpoints."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from tqdm import tqdm

from cartpole_rl.commands.config import TrainConfig
from cartpole_rl.evaluation import episode_metrics
from cartpole_rl.learning.checkpoints import BEST, FOLDER, LAST, save_agent, save_training
from cartpole_rl.learning.training import Scalars, Training
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.reporting.animation import gif
from cartpole_rl.reporting.figures import behaviour
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.tasks.episode import Episode

HISTORY = "history.jsonl"  # a line an evaluation
COMPARED = ("score", "score_upright", "steps", "time_to_upright_s", "upright_fraction")  # on the HPARAMS page
PICTURES = 4  # behaviour figures and animations in TensorBoard, over the whole training


class TrainingMonitor:
    """Listens to one training in the run folder `folder`; a context manager around `Training.run`.

    A resumed training hands in the frames it has seen, and what was written after them is written anew.
    """

    def __init__(self, folder: Path, config: TrainConfig, weights: Any, resumed_at: int | None = None) -> None:
        self.folder, self.config = folder, config
        self._weights = weights  # a function that gives the agent's weights
        self._seen = resumed_at or 0
        self._log = TensorBoardLog(folder, purge_step=None if resumed_at is None else resumed_at + 1)
        self._bar = tqdm(
            total=config.learning.frames, initial=self._seen, unit=" frames", unit_scale=True, mininterval=1.0
        )
        self.history = [record for record in read_history(folder) if record["frames"] <= self._seen]
        write_history(folder, self.history)

    def __enter__(self) -> "TrainingMonitor":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        self._log.close()

    def learned(self, frames: int, scalars: Scalars) -> None:
        """Curves and the progress bar."""
        self._log.scalars(scalars, frames)
        self._bar.update(frames - self._seen)
        self._seen = frames

    def evaluated(self, frames: int, seconds: float, episodes: Sequence[Episode], is_best: bool) -> None:
        """Scores, pictures now and then, and the last and the best checkpoint."""
        figures = [episode_metrics(episode, self.config.task.x_max) for episode in episodes]
        scores = [figure["score"] for figure in figures]
        record = {
            "frames": frames,
            "seconds": seconds,
            "score": float(np.mean(scores)),
            "score_min": min(scores),
            "score_max": max(scores),
            "score_upright": float(np.mean([figure["score_upright"] for figure in figures])),
            "steps": float(np.mean([figure["steps"] for figure in figures])),
            "upright_fraction": float(np.mean([figure["upright_fraction"] for figure in figures])),
        }
        self.history.append(record)
        write_history(self.folder, self.history)
        self._log.scalars({f"evaluation/{key}": value for key, value in record.items() if key != "frames"}, frames)
        self._bar.set_postfix_str(f"score {record['score']:.0f}")
        if len(self.history) % max(1, self.config.learning.evaluations // PICTURES) == 0:
            self._show(episodes[0], frames)
        for name in (LAST, BEST) if is_best else (LAST,):
            save_agent(
                self.folder / FOLDER / name,
                self.config.model_dump(mode="json"),
                self._weights(),
                frames,
                record["score"],
            )

    def checkpoint(self, training: Training) -> None:
        """The state to resume from."""
        self._log.flush()
        save_training(
            self.folder,
            {**training.snapshot(), "config": self.config.model_dump(mode="json"), "frames": training.frames},
        )

    def randomization(self, plant: SimulatedPlant) -> None:
        """Histograms of the parameters in force on all carts."""
        for name in (*plant.randomizer.ranges, "pole_length"):
            self._log.histogram(f"randomization/{name}", getattr(plant.parameters, name).cpu().numpy(), self._seen)

    def finished(self, metrics: dict[str, float | None]) -> None:
        """The run's line on TensorBoard's HPARAMS page."""
        shown = {key: value for key in COMPARED if (value := metrics.get(key)) is not None}
        self._log.hparams(self.config.model_dump(mode="json"), shown)

    def _show(self, episode: Episode, frames: int) -> None:
        half = self.config.task.x_max
        length = 2 * self.config.pole.nominal.pole_com
        self._log.figure("behaviour", behaviour(episode, f"After {frames / 1e6:.1f} M frames", half), frames)
        self._log.animation("cart", gif(episode, length, half), frames)


def read_history(folder: Path) -> list[dict[str, float]]:
    """The evaluations of a training so far, oldest first."""
    path = folder / HISTORY
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def write_history(folder: Path, history: Sequence[dict[str, float]]) -> None:
    """What `read_history` reads."""
    (folder / HISTORY).write_text("".join(json.dumps(record) + "\n" for record in history))


