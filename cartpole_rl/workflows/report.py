"""Writes the results of episodes: metrics.json and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.animation import durations, frames, write_animation
from cartpole_rl.reporting.figures import behaviour, learning_curve, save
from cartpole_rl.run_files import ANIMATION, FIGURES, METRICS
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.origins import stored_origins
from cartpole_rl.workflows.run_folder import write_json


def report(
    folder: Path,
    episodes: Sequence[Episode],
    plant: str,
    pole: PoleSettings,
    x_max: float,
    link: Mapping[str, int] | None = None,
    history: Sequence[Mapping[str, float]] = (),
    mp4: bool = False,
) -> dict[str, Any]:
    """Write metrics.json and figures/ into `folder`, and return the summary of the episodes (`summarize`).

    The behaviour figure and the animation show the first episode; `history` adds the learning curve,
    `mp4` the animation as an MP4.
    """
    metrics = [episode_metrics(episode, x_max) for episode in episodes]
    summary = summarize(metrics)
    header = {"plant": plant, "pole": pole.name, **(link or {})}
    cart, origins = stored_origins(episodes)
    listed = [{**each, **origin} for each, origin in zip(metrics, origins, strict=True)]
    write_json(folder / METRICS, {**header, **summary, **cart, "episodes": listed})
    figures = folder / FIGURES
    save(behaviour(episodes[0], f"First episode, plant={plant}", x_max), figures / "behaviour.png")
    pictures = [*frames(episodes[0], pole.nominal.length, x_max, f"plant={plant}")]
    write_animation(figures / ANIMATION, pictures, durations(episodes[0]), mp4)
    if history:
        save(learning_curve([("score", list(history))]), figures / "learning_curve.png")
    return summary
