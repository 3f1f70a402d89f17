"""Figure of one episode: angle, position and motor value over time (thesis, figures 6.2 and 6.10).

The thesis scales the three to one axis; here each has a panel with its unit, on a common time axis.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.reporting import style
from cartpole_rl.reporting.texts import ending_text, guard_text
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE
from cartpole_rl.tasks.upright import is_upright, upright_since

SMALL_SWING = 40.0  # deg; the angle axis of an episode within it is enlarged
MOTOR_TICKS = (-250, -125, 0, 125, 250)

Array = NDArray[np.float64]


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
    """Draw the cart's position between the ends of its track."""
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
    return f"score {episode.score.sum():.0f},  {shares},  {ending_text(episode)}"
