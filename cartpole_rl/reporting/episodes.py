"""Results of episodes: metrics.json, the learning curve, and one episode over time.

The learning curve is figure 6.9 of the thesis. Its figures 6.2 and 6.10 scale angle, position and motor value
to one axis; here each has a panel with its unit, on a common time axis.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.evaluation.metrics import episode_metrics, summarize
from cartpole_rl.evaluation.recordings import stored_origins
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting import style
from cartpole_rl.reporting.animation import durations, frames, write_animation
from cartpole_rl.reporting.texts import SCORES, ending_text, guard_text
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.run_folder import ANIMATION, FIGURES, METRICS, write_json
from cartpole_rl.tasks.episode import Episode, is_upright, upright_since
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE
from cartpole_rl.tasks.settings import Measure, TaskSettings

SMALL_SWING = 40.0  # deg; the angle axis of an episode within it is enlarged
MILLION = 1e6
MOTOR_TICKS = (-250, -125, 0, 125, 250)

Array = NDArray[np.float64]


def report_episodes(
    folder: Path,
    episodes: Sequence[Episode],
    plant: str,
    pole: PoleSettings,
    task: TaskSettings,
    track_half_length: float,
    link: Mapping[str, int] | None = None,
    history: Sequence[Mapping[str, float]] = (),
    onboard: Sequence[Episode] = (),
    mp4: bool = False,
) -> dict[str, Any]:
    """Write figures/ and metrics.json into `folder`, and return the summary of the episodes (`summarize`).

    metrics.json is written last: a run that has it is complete. If a figure cannot be written, it is written
    all the same, and OSError is raised.
    `track_half_length`, m, is that of carts that do not tell theirs.
    Behaviour figure and animation show the first episode; `mp4` adds the animation as an MP4. `history` adds
    the learning curve, `onboard` the episodes that the cart's board drove, under that key of metrics.json and
    of the summary.
    """
    track = track_half_length
    summary, listed = summarized(episodes, track)
    header = {"plant": plant, "pole": pole.name, **(link or {})}
    cart, origins = stored_origins(episodes)
    listed = [{**each, **origin} for each, origin in zip(listed, origins, strict=True)]
    content = {**header, **summary, **cart, "episodes": listed}
    figures, failed = folder / FIGURES, None
    if onboard:
        summary["onboard"], listed = summarized(onboard, track)
        content["onboard"] = {**summary["onboard"], "episodes": listed}
    try:
        if onboard:
            draw(onboard[0], figures, "onboard_", f"plant={plant}, on the board", pole, track, mp4)
        draw(episodes[0], figures, "", f"plant={plant}", pole, track, mp4)
        if history:
            style.save(learning_curve(history, task.measure), figures / "learning_curve.png")
    except OSError as error:  # such as a full disk: the numbers are few, and need less room
        failed = error
    write_json(folder / METRICS, content)
    if failed is not None:
        raise failed
    return summary


def summarized(episodes: Sequence[Episode], track: float) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the summary of episodes, and the metrics of each; `track` is half its length, m."""
    metrics = [episode_metrics(episode, track) for episode in episodes]
    return summarize(metrics), metrics


def draw(
    episode: Episode, folder: Path, prefix: str, title: str, pole: PoleSettings, track: float, mp4: bool
) -> None:
    """Write the behaviour figure and the animation of the first episode."""
    style.save(behaviour(episode, f"First episode, {title}", track), folder / f"{prefix}behaviour.png")
    pictures = [*frames(episode, pole.nominal.length, track, title)]
    write_animation(folder / f"{prefix}{ANIMATION}", pictures, durations(episode), mp4)


def learning_curve(history: Sequence[Mapping[str, Any]], measure: Measure) -> Figure:
    """Draw the mean of each evaluation over millions of transitions, in a band from worst to best episode.

    Each record of `history`, one or more, has `transitions`, and over the episodes of that evaluation the
    `measure` (mean), `score_min` and `score_max`.
    """
    figure = style.new_figure(height=4.4)
    axes = figure.subplots()
    style.dress(axes, x="transitions (millions)", y=f"{SCORES[measure]} of an episode")
    keys = ("transitions", measure, "score_min", "score_max")
    transitions, means, lowest, highest = np.array([[each[key] for key in keys] for each in history], float).T
    millions, colour = transitions / MILLION, style.series_colour(0)
    axes.fill_between(millions, lowest, highest, color=colour, alpha=0.13, linewidth=0)
    marker = "o" if len(millions) == 1 else ""
    axes.plot(millions, means, marker=marker, color=colour, linewidth=2.2, label=measure)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, steps=(1, 2, 5, 10)))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.legend(loc="lower right", fontsize=style.SMALL_SIZE, frameon=True, framealpha=0.9, edgecolor="none")
    style.title(axes, "Learning curve", "line: mean,  band: worst to best episode")
    return figure


def behaviour(episode: Episode, title: str = "One episode", track_half_length: float | None = None) -> Figure:
    """Draw angle (deg, wrapped), position (cm) and motor value of one episode over time (s).

    `track_half_length` in m draws the ends of the track. The line under the title states the score, equation
    (6.2), the share of time for which the pole was upright, and how the episode ended.
    """
    figure = style.new_figure(height=6.2)
    angle, position, motor = figure.subplots(3, 1, sharex=True, height_ratios=(2.2, 1.3, 1.0))
    _draw_angle(angle, episode)
    _draw_position(position, episode, track_half_length)
    _draw_motor(motor, episode)
    style.title(angle, style.plain(title), _summary(episode))
    figure.align_ylabels()
    return figure


def wrapped_line(time: Array, theta: Array) -> tuple[Array, Array]:
    """Return the angle as a line: times (s) and degrees in [-180, 180], interrupted where the angle wraps.

    `time` [T] in s and `theta` [T] in rad, wrapped or not, become arrays of at least T points. Where the pole
    passes the bottom, the line ends at one edge (NaN) and continues from the other, instead of crossing the
    panel.
    """
    degrees = np.degrees(np.unwrap(theta))
    turns = np.ceil((degrees - 180.0) / 360.0)  # 0 within (-180, 180]
    wrapped = degrees - 360.0 * turns
    times, angles = list(time[:1]), list(wrapped[:1])
    for i in range(1, len(time)):
        if turns[i] != turns[i - 1]:
            side = np.sign(turns[i] - turns[i - 1])  # 1: leaves at 180, enters at -180
            way = side * 180.0 - wrapped[i - 1]
            moment = time[i - 1] + (time[i] - time[i - 1]) * way / (degrees[i] - degrees[i - 1])
            times += [moment, moment, moment]
            angles += [side * 180.0, math.nan, -side * 180.0]
        times.append(time[i])
        angles.append(wrapped[i])
    return np.array(times), np.array(angles)


def _draw_angle(axes: Axes, episode: Episode) -> None:
    """Draw the wrapped angle, the upright band, and the time from which the pole stays up."""
    style.dress(axes, y="pole angle (deg)")
    band = math.degrees(UPRIGHT_ANGLE)
    axes.axhspan(-band, band, color=colours.UPRIGHT, alpha=0.2, linewidth=0)
    axes.plot(*wrapped_line(episode.time, episode.theta), color=colours.POLE, linewidth=1.6)
    style.beside(axes, 0, "upright", colours.UPRIGHT)
    largest = float(np.degrees(np.abs(episode.theta)).max())
    if largest < SMALL_SWING:
        reach = 1.15 * max(largest, 1.3 * band)
        axes.set_ylim(-reach, reach)
    else:
        axes.set_ylim(-190, 190)
        axes.set_yticks((-180, -90, 0, 90, 180))
        style.beside(axes, 180, "hanging", colours.MUTED)
        style.beside(axes, -180, "hanging", colours.MUTED)
    axes.set_xlim(episode.time[0], episode.time[-1])
    moment = upright_since(episode.time, episode.theta)
    if moment is not None and moment > episode.time[0]:
        style.at_time(axes, moment, f"up from {moment:.1f} s", colours.UPRIGHT)


def _draw_position(axes: Axes, episode: Episode, track_half_length: float | None) -> None:
    style.dress(axes, y="cart (cm)")
    position = 100 * episode.x
    axes.plot(episode.time, position, color=colours.CART, linewidth=1.6)
    reach = max(1.15 * float(np.abs(position).max()), 2.0)
    if track_half_length is not None:
        end = 100 * track_half_length
        reach = max(reach, 1.15 * end)
        for side in (-end, end):
            axes.axhline(side, color=colours.LIMIT, linewidth=1.4)
            style.beside(axes, side, "end of track", colours.LIMIT)
    axes.set_ylim(-reach, reach)


def _draw_motor(axes: Axes, episode: Episode) -> None:
    """Draw the motor value sent in each period; the periods of the track guard are marked."""
    style.dress(axes, x="time (s)", y="motor value")
    axes.stairs(episode.motor, episode.time, fill=True, color=colours.MOTOR, alpha=0.35)
    axes.stairs(episode.motor, episode.time, baseline=None, color=colours.MOTOR, linewidth=1.0)
    if episode.guarded is not None and episode.guarded.any():
        guarded = np.where(episode.guarded, episode.motor, 0)
        axes.stairs(guarded, episode.time, fill=True, color=colours.LIMIT)
        times = episode.time[:-1][episode.guarded]  # a single period is a thin line: marked at the edge too
        edge = np.full_like(times, 1.08 * LARGEST_MOTOR)
        axes.plot(times, edge, "v", color=colours.LIMIT, markersize=4, clip_on=False)
        style.beside(axes, 0, "track guard", colours.LIMIT)
    axes.set_ylim(-1.15 * LARGEST_MOTOR, 1.15 * LARGEST_MOTOR)
    axes.set_yticks(MOTOR_TICKS)
    style.beside(axes, MOTOR_TICKS[-1], "pushes right", colours.MUTED)
    style.beside(axes, MOTOR_TICKS[0], "pushes left", colours.MUTED)


def _summary(episode: Episode) -> str:
    """Return the episode in one line."""
    share = 100 * is_upright(episode.theta[1:]).mean()
    shares = f"upright {share:.0f} % of the time{guard_text(episode)}"
    return f"score {episode.score.sum():z.0f},  {shares},  {ending_text(episode)}"


def columns(name: str, episode: Episode, track: float, ghost: Array | None = None) -> dict[str, Any]:
    """Return what the page of `view=web` shows of an episode on a track of +-`track` m; None if not finite.

    `ghost` [2, T + 1] has the positions, m, and angles, rad, of a cart beside it, NaN where there is none.
    """
    rows = len(episode.time)
    guarded = episode.guarded if episode.guarded is not None else np.zeros(episode.steps)
    beside = np.full((2, rows), np.nan) if ghost is None else ghost
    motor = episode.motor.tolist()
    steps = {
        "motor": [*motor, *(motor[-1:] or [0])],
        "guard": [*(np.sign(episode.motor) * guarded).astype(int).tolist(), 0],
    }
    series = {
        "x": episode.x,
        "theta": episode.theta,
        "ghost_x": beside[0],
        "ghost_theta": beside[1],
        "score": [0.0, *episode.score.cumsum().round(1)],
    }
    rounded = {
        name: [round(float(value), 5) if np.isfinite(value) else None for value in values]
        for name, values in series.items()
    }
    about = {"name": name, "track": track, "pole": episode.pole_length}
    return {**about, "time": episode.time.tolist(), **rounded, **steps}
