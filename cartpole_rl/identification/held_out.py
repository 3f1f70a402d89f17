"""Splits recordings into those that a model learns from and held-out ones that judge it."""

from collections.abc import Sequence
from dataclasses import replace

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.windows import Windows, cut_windows, history_periods, lead_periods
from cartpole_rl.tasks.episode import Episode

HELD_OUT = 5  # one recording in so many is held out
LEAD = 0.2  # s of a window that give its initial state


def split(episodes: Sequence[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Return episodes to learn from and held-out ones: every fifth, or the last fifth of each of a few."""
    if len(episodes) >= HELD_OUT:
        chosen = range(HELD_OUT // 2, len(episodes), HELD_OUT)
        return (
            [episode for number, episode in enumerate(episodes) if number not in chosen],
            [episodes[number] for number in chosen],
        )
    ends = [episode.steps - episode.steps // HELD_OUT for episode in episodes]
    return (
        [part(episode, 0, end) for episode, end in zip(episodes, ends, strict=True)],
        [part(episode, end, episode.steps) for episode, end in zip(episodes, ends, strict=True)],
    )


def part(episode: Episode, first: int, last: int) -> Episode:
    """Return the periods from `first` up to, and without, `last` as an episode."""
    rows = {"time", "x", "x_dot", "theta", "theta_dot", "counts"}
    cut = {name: getattr(episode, name)[first : last + 1] for name in rows}
    steps = {
        name: getattr(episode, name)[first:last] for name in ("motor", "score", "score_upright", "reward")
    }
    guarded = None if episode.guarded is None else episode.guarded[first:last]
    return replace(episode, **cut, **steps, guarded=guarded)


def held_out_windows(episodes: Sequence[Episode], period: float, horizon: float) -> Windows:
    """Return windows of a lead and `horizon` s, overlapping by half.

    The motor values before each window are those of its episode. `Windows.episode` counts the episodes, then
    the same without the first half window. Raises RecordingError if there is no window.
    """
    history, lead = history_periods(period), lead_periods(LEAD, period)
    ahead = lead + round(horizon / period)
    later = [part(episode, min((history + ahead) // 2, episode.steps), episode.steps) for episode in episodes]
    seconds = (history + ahead) * period
    try:
        cut = cut_windows([*episodes, *later], period, seconds, most=1000)
    except RecordingError:
        raise RecordingError(
            f"the held-out recordings have no {seconds:.2f} s without a lost frame: record longer episodes"
        ) from None
    return cut._replace(
        positions=cut.positions[history:], motors=cut.motors[history:], first=cut.first + history, lead=lead
    )
