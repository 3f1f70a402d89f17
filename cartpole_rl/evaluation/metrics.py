"""Metrics of an episode, and their means over several."""

import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from cartpole_rl.settings import CONFIDENCE
from cartpole_rl.tasks.episode import (
    HOLD,
    Ending,
    Episode,
    falls,
    is_upright,
    upright_at_end,
    upright_since,
    wrap,
)

RESAMPLES = 5000
AT_ONCE = 10_000_000  # resampled values in memory
MOST_LEFT_OUT = 5000
RECOVERY = 5.0  # s that each pole has after a fall


def episode_metrics(episode: Episode, track_half_length: float) -> dict[str, Any]:
    """Return the metrics of one episode for metrics.json; None if a metric is undefined.

    `score` and `score_upright` are the sums of (6.2) and (6.1); `time_to_upright_s` the first time from which
    the pole stays within 5 degrees for 1 s; `upright_fraction` the share of periods within 5 degrees, over
    which the RMS of angle and position are taken; `rms_motor_change` that of the step from one motor value to
    the next; `motor_reversals_per_s` how often the motor changes its direction; `guarded_fraction` the share
    of periods in which the track guard replaced the agent's motor value; `upright_at_end` is 1 if the pole is
    within 5 degrees for the last second of a full-length episode; `min_track_margin_m` the smallest distance
    from the track's end, negative beyond it: from its own on a simulated cart, else from `track_half_length`.
    `falls` counts how often a pole that had stood for 1 s fell below the horizontal; `recovered_fraction` is
    the share of them after which it stood again within 5 s, without those that time, a fault or the link cut
    off; `recovery_s` and `recovery_swings` are the mean time and the mean number of swings through the
    hanging position until then.
    Only an episode that the cart's board drove has `same_as_host_fraction`, the share of the compared periods
    with the motor value that this computer would have sent, and `not_compared_steps`, the number of the other
    periods.
    """
    upright = is_upright(episode.theta[1:])
    end = track_half_length
    if episode.origin is not None:
        end = episode.origin.parameters.get("track_half_length", end)
    return {
        "score": float(episode.score.sum()),
        "score_upright": float(episode.score_upright.sum()),
        "reward": float(episode.reward.sum()),
        "steps": episode.steps,
        "ended_by": episode.ended_by,
        "time_to_upright_s": upright_since(episode.time, episode.theta),
        "upright_fraction": float(upright.mean()),
        "upright_at_end": float(
            episode.ended_by == Ending.TIME and upright_at_end(episode.time, episode.theta)
        ),
        "rms_angle_rad": _rms(wrap(episode.theta[1:])[upright]),
        "rms_position_m": _rms(episode.x[1:][upright]),
        "rms_motor_change": _rms(np.diff(episode.motor)),
        "motor_reversals_per_s": _reversals_per_s(episode),
        "guarded_fraction": None if episode.guarded is None else float(episode.guarded.mean()),
        "min_track_margin_m": float(end - np.abs(episode.x).max()),
        **_recovery(episode),
        **_same_as_host(episode),
    }


def _recovery(episode: Episode) -> dict[str, Any]:
    every = falls(episode.time, episode.theta)
    lost = episode.ended_by in (Ending.TRACK, Ending.ANGLE)  # by the agent: it has not recovered
    timely = [each for each in every if lost or each.moment + RECOVERY + HOLD <= episode.time[-1]]
    back = [each for each in timely if each.recovery is not None and each.recovery <= RECOVERY]
    return {
        "falls": len(every),
        "recovered_fraction": len(back) / len(timely) if timely else None,
        "recovery_s": float(np.mean([each.recovery for each in back])) if back else None,
        "recovery_swings": float(np.mean([each.swings for each in back])) if back else None,
    }


def same_as_host(episode: Episode) -> tuple[int, int]:
    """Return how many motor values of board and computer agree, and how many were compared."""
    assert episode.expected is not None
    assert episode.compared is not None
    same = (episode.motor == episode.expected) & episode.compared
    return int(same.sum()), int(episode.compared.sum())


def _same_as_host(episode: Episode) -> dict[str, Any]:
    if episode.expected is None:
        return {}
    same, count = same_as_host(episode)
    return {
        "same_as_host_fraction": same / count if count else None,
        "not_compared_steps": episode.steps - count,
    }


def _reversals_per_s(episode: Episode) -> float | None:
    """Return how often the sign of the motor value changes, zeros left out."""
    directions = np.sign(episode.motor[episode.motor != 0])
    seconds = float(episode.time[-1] - episode.time[0])
    return float(np.count_nonzero(np.diff(directions))) / seconds if seconds > 0 else None


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def interval(values: Sequence[float]) -> tuple[float, float] | tuple[None, None]:
    """Return the 95 % interval of the mean by BCa bootstrap (Efron, 1987); (None, None) for one value.

    More than MOST_LEFT_OUT values have the percentile interval: BCa takes the mean without each in turn.
    """
    return _interval(tuple(values))


@lru_cache(maxsize=64)  # an evaluation prints what it writes
def _interval(values: tuple[float, ...]) -> tuple[float, float] | tuple[None, None]:
    from scipy import stats  # slow to import

    data = np.asarray(values, dtype=float)
    if len(data) < 2:
        return None, None
    if np.ptp(data) == 0:
        return float(data[0]), float(data[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about samples that differ only by rounding
        result = stats.bootstrap(
            (data,),
            np.mean,
            method="BCa" if len(data) <= MOST_LEFT_OUT else "percentile",
            confidence_level=CONFIDENCE,
            rng=np.random.default_rng(0),
            n_resamples=RESAMPLES,
            batch=max(1, AT_ONCE // len(data)),
        )
    low, high = (float(edge) for edge in result.confidence_interval)
    if math.isfinite(low) and math.isfinite(high):
        return low, high
    # BCa is undefined for those
    low, high = stats.t.interval(CONFIDENCE, len(data) - 1, data.mean(), stats.sem(data))
    return float(low), float(high)


def summarize(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return mean and interval of each metric over the episodes that have it, and counts of the endings."""
    summary: dict[str, Any] = {}
    for key in episodes[0]:
        values = [episode[key] for episode in episodes]
        if key == "ended_by":
            summary[key] = dict(Counter(values))
            continue
        present = [value for value in values if value is not None]
        if not present:
            summary[key] = None
            continue
        low, high = interval(present)
        summary[key] = {"mean": float(np.mean(present)), "low": low, "high": high, "count": len(present)}
    return summary
