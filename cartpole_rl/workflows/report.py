"""Writes the results of episodes: metrics.json and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.animation import durations, frames, write_animation
from cartpole_rl.reporting.episodes import behaviour
from cartpole_rl.reporting.scores import learning_curve
from cartpole_rl.reporting.style import save
from cartpole_rl.run_folder import ANIMATION, FIGURES, METRICS, write_json
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import TaskSettings
from cartpole_rl.workflows.origins import stored_origins


def report(
    folder: Path,
    episodes: Sequence[Episode],
    plant: str,
    pole: PoleSettings,
    task: TaskSettings,
    link: Mapping[str, int] | None = None,
    history: Sequence[Mapping[str, float]] = (),
    onboard: Sequence[Episode] = (),
    mp4: bool = False,
) -> dict[str, Any]:
    """Write figures/ and metrics.json into `folder`, and return the summary of the episodes (`summarize`).

    metrics.json is written last: a run that has it is complete.

    Behaviour figure and animation show the first episode; `mp4` adds the animation as an MP4. `history` adds
    the learning curve, `onboard` the episodes that the cart's board drove, under that key of metrics.json and
    of the summary.
    """
    x_max = task.x_max
    summary, listed = summarized(episodes, x_max)
    header = {"plant": plant, "pole": pole.name, **(link or {})}
    cart, origins = stored_origins(episodes)
    listed = [{**each, **origin} for each, origin in zip(listed, origins, strict=True)]
    content = {**header, **summary, **cart, "episodes": listed}
    figures = folder / FIGURES
    if onboard:
        summary["onboard"], listed = summarized(onboard, x_max)
        content["onboard"] = {**summary["onboard"], "episodes": listed}
        draw(onboard[0], figures, "onboard_", f"plant={plant}, on the board", pole, x_max, mp4)
    draw(episodes[0], figures, "", f"plant={plant}", pole, x_max, mp4)
    if history:
        curve = learning_curve([(task.measure, list(history))], measure=task.measure)
        save(curve, figures / "learning_curve.png")
    write_json(folder / METRICS, content)
    return summary


def summarized(episodes: Sequence[Episode], x_max: float) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the summary of episodes, and the metrics of each."""
    metrics = [episode_metrics(episode, x_max) for episode in episodes]
    return summarize(metrics), metrics


def draw(
    episode: Episode, folder: Path, prefix: str, title: str, pole: PoleSettings, x_max: float, mp4: bool
) -> None:
    """Write the behaviour figure and the animation of the first episode."""
    save(behaviour(episode, f"First episode, {title}", x_max), folder / f"{prefix}behaviour.png")
    pictures = [*frames(episode, pole.nominal.length, x_max, title)]
    write_animation(folder / f"{prefix}{ANIMATION}", pictures, durations(episode), mp4)
