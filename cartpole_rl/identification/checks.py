"""Checks of recordings, before and after a fit. A message says what is wrong and what to do.

A fit returns a cart for any data. These checks refuse data that no cart could have produced.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.prediction import REPORTED, Replayed, away_from_upright, replay
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.sensors import Motion, question_sensors, samples_of
from cartpole_rl.identification.windows import mean_gap, naming
from cartpole_rl.plants.measured import SUDDEN_CART
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.tasks.episode import Episode, wrap

Array = NDArray[np.floating]
SAME_PERIOD = 0.02  # share by which the period of a recording may differ
SHORTEST = 20.0  # s
SHORTEST_HELD_OUT = 5.0  # s
LEAST_TRAVEL, LEAST_SWING = 0.05, 0.35  # m, rad
LEAST_OF_EACH = 0.01, 0.05  # m, rad, in each recording: less than any experiment's
STILL, STILL_ANGLE, STILL_SPREAD = 0.3, 0.2, 0.02  # s, rad from hanging, rad
BALANCED, BALANCED_ANGLE, BALANCED_MEAN = 5.0, 0.35, 0.1  # s; rad from upright, of the angle and of its mean
PASSING = 0.3  # rad from upright
FLICKER = 0.01  # rad to both sides of its mean: a pole that lies on a stop does not move
FROZEN = 1.0  # s
ZERO_INTERVAL = 0.02  # rad, 95 % of the zero that motion tells
STRONG, MOVES = 150, 0.03  # motor value; m of cart that move a hanging pole
STRONG_SHARE = 0.3  # of a standstill's motor values: no cart with a swinging pole stands still under so many
TOLERANCE = 2.0  # counts by which positions in SI units may differ from counts
SIGNIFICANT = 0.2  # correlation from which its sign is certain
UNEXPLAINED = 0.5  # RMS error of a prediction over the RMS motion; about 0.02 for a cart of this kind
SMALL = (0.01, 0.09)  # m, rad: a smaller error is never unexplained
SHORT = 0.3  # s, of a recording whose pole is never away from upright for longer


def check_recordings(
    fitted: Mapping[str, Episode],
    held_out: Mapping[str, Episode],
    period: float,
    on_step: Callable[[], object] = lambda: None,
) -> None:
    """Raise RecordingError for the first problem of the recordings, by the names of their files.

    Each one must show a driven cart and a moving pole; those `fitted` to must show them well together, and so
    must those `held_out`. `on_step` is called at intervals of a slow check.
    """
    check_each({**fitted, **held_out}, period)
    with naming(", ".join(held_out) if len(held_out) < 3 else f"the {len(held_out)} held-out recordings"):
        judges = [*held_out.values()]
        if (seconds := period * sum(episode.steps for episode in judges)) < SHORTEST_HELD_OUT:
            raise RecordingError(
                f"{seconds:.1f} s are too short to judge a fit; give {SHORTEST_HELD_OUT:g} s or more"
            )
        _check_motion(judges, LEAST_TRAVEL, LEAST_SWING)
    episodes = [*fitted.values()]
    seconds = period * sum(episode.steps for episode in episodes)
    if seconds < SHORTEST:
        raise RecordingError(f"{seconds:.1f} s of recordings are too short; record {SHORTEST:g} s or more")
    _check_motion(episodes, LEAST_TRAVEL, LEAST_SWING)
    check_directions(episodes, period)
    rests = any(_hangs_still(each, period) or stays_up(each, period) for each in episodes)
    if not rests and not zero_is_known(episodes, period, on_step):
        raise RecordingError(
            "the pole never hangs still and is never balanced for 5 s in the recordings, and its motion does "
            "not tell its zero; start one with half a second of the pole at rest"
        )


def check_each(recordings: Mapping[str, Episode], period: float) -> None:
    """Raise RecordingError for the first recording, by its file, of no driven cart with a moving pole."""
    for file, episode in recordings.items():
        with naming(file):
            check_period(episode, period)
            _check_units(episode)
            if not np.ptp(episode.motor):
                raise RecordingError(
                    f"the motor value is {episode.motor[0]} throughout; record it with others, "
                    "or leave it out"
                )
            _check_motion([episode], *LEAST_OF_EACH)
            _check_encoders(episode, period)


def shared_period(recordings: Mapping[str, Episode]) -> float:
    """Return the control period of recordings, s, by the names of their files: the median.

    Raises RecordingError for the first one of another period.
    """
    gaps = {file: mean_gap(episode.time) for file, episode in recordings.items() if episode.steps}
    usual = sorted(gaps, key=lambda file: gaps[file])[(len(gaps) - 1) // 2]
    period = gaps[usual]
    for file, other in gaps.items():
        if abs(other / period - 1) > SAME_PERIOD:
            raise RecordingError(
                f"{file} has a frame every {1e3 * other:g} ms, {usual} every {1e3 * period:g} ms: give "
                "recordings of one control period"
            )
    return period


def check_period(episode: Episode, period: float) -> None:
    """Raise RecordingError for a recording of another control period, s."""
    if not episode.steps:
        return
    found = mean_gap(episode.time)
    if abs(found / period - 1) > SAME_PERIOD:
        raise RecordingError(
            f"a frame every {1e3 * found:g} ms, not every {1e3 * period:g} ms: give "
            f"control_period={found:g}, and recordings of one period"
        )


def check_directions(episodes: Sequence[Episode], period: float) -> None:
    """Raise RecordingError if the angle is half a turn off, or the sign of a column is wrong."""
    samples = samples_of(motions(episodes), period)
    if samples is None:
        return
    if samples.falls_upwards:
        raise RecordingError(
            "the pole falls upwards in the recordings: the angle is half a turn off; 0 is upright"
        )
    if samples.response < -SIGNIFICANT:
        raise RecordingError(
            "positive motor values push the cart towards smaller counts: swap the motor's wires, or the "
            "cart encoder's channels"
        )
    if samples.lag < -SIGNIFICANT:
        raise RecordingError(
            "the pole runs ahead of its cart instead of staying behind: swap the pole encoder's channels"
        )


def check_same_encoders(recordings: Mapping[str, Episode], hardware: Hardware) -> None:
    """Raise RecordingError for the first recording, by its file, of a cart with other encoders."""
    encoders = hardware.encoders
    for file, episode in recordings.items():
        if episode.encoders != encoders:
            raise RecordingError(
                f"{file} is of a cart with {episode.encoders.text}, not {encoders.text}; "
                "give the file of that cart with cart="
            )


def zero_is_known(episodes: Sequence[Episode], period: float, on_step: Callable[[], object]) -> bool:
    """Return True if motion tells the zero of the angle."""
    zero = question_sensors(motions(episodes), period, on_step=on_step).angle_zero
    return zero is not None and zero.high - zero.low < ZERO_INTERVAL


def motions(episodes: Sequence[Episode]) -> list[Motion]:
    """Return the motion in each episode, upright at 0 where its pole passes upright."""
    return [Motion(each.x, about_upright(each.theta), each.motor.astype(float)) for each in episodes]


def about_upright(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles, rad, less whole turns: the one nearest to upright is near 0.

    A log that begins beyond a whole turn has its upright there. With a wrong scale, that is not 0.
    """
    beside = np.abs(wrap(theta))
    nearest = int(beside.argmin())
    turns = np.round(theta[nearest] / (2 * np.pi)) if beside[nearest] < PASSING else 0.0
    return theta - 2 * np.pi * turns


def shows_motion(episode: Episode) -> bool:
    """Return True if the motor value changes, and cart and pole move enough to be fitted to."""
    travel, swing = LEAST_OF_EACH
    if not episode.steps:
        return False
    return bool(np.ptp(episode.motor) and np.ptp(episode.x) >= travel and np.ptp(episode.theta) >= swing)


def check_explained(recordings: Mapping[str, Episode], dynamics: Dynamics, horizon: float) -> list[Replayed]:
    """Return each recording beside its replay by the fitted cart; see `replay` for `horizon`, s.

    Raises RecordingError for the one that the cart explains least, by the name of its file, if that is too
    little. A single wrong recording spoils the fit to all of them, so the first that fails need not be it.
    """
    replays = replay(recordings, dynamics, horizon)
    errors = [(*_unexplained(each, horizon), file) for file, each in zip(recordings, replays, strict=True)]
    share, message, file = max(errors, default=(0.0, "", ""))
    if share > UNEXPLAINED:
        with naming(file):
            raise RecordingError(message)
    return replays


def hardly_explained(
    recordings: Mapping[str, Episode], replays: Sequence[Replayed], dynamics: Dynamics
) -> list[str]:
    """Return a warning for each of the recordings that `check_explained` cannot judge, by SHORT s of it.

    In so little time a motor that failed once looks like a recording of another cart.
    """
    unjudged = {
        file: episode
        for (file, episode), each in zip(recordings.items(), replays, strict=True)
        if not away_from_upright(each).any()
    }
    if not unjudged:
        return []
    short = replay(unjudged, dynamics, SHORT)
    errors = {file: _unexplained(each, SHORT) for file, each in zip(unjudged, short, strict=True)}
    return [f"{file}: {message}" for file, (share, message) in errors.items() if share > UNEXPLAINED]


def _unexplained(replayed: Replayed, horizon: float) -> tuple[float, str]:
    """Return the larger error of cart and pole as a share of its motion, and a message; 0 if it is small."""
    kept, found = away_from_upright(replayed), (0.0, "")
    if not kept.any():
        return found
    for name, values, errors, small, (unit, factor) in zip(
        ("cart", "pole"),
        (replayed.x, replayed.theta),
        (replayed.x_error, replayed.theta_error),
        SMALL,
        REPORTED.items(),
        strict=True,
    ):
        measured = values - errors
        error, motion = (
            factor * np.sqrt(np.mean(each[kept] ** 2)) for each in (errors, measured - measured[:, :1])
        )
        share = float(error / motion) if motion else math.inf
        if error > factor * small and share > found[0]:
            found = (
                share,
                f"no cart explains this recording: {horizon:g} s of the {name}'s motion, {motion:.0f} "
                f"{unit.rpartition('_')[2]}, is predicted {error:.0f} wrong; check its motor values "
                "and counts, and that all recordings are of one cart, or leave it out",
            )
    return found


def _check_motion(episodes: Sequence[Episode], travel: float, swing: float) -> None:
    """Refuse recordings in which the cart moves less than `travel` m, or the pole less than `swing` rad."""
    moves, swings = (
        max(float(np.ptp(each)) for each in values)
        for values in ([episode.x for episode in episodes], [episode.theta for episode in episodes])
    )
    if moves < travel:
        raise RecordingError(
            f"the cart moves {1e3 * moves:.0f} mm in all: too little to identify its friction and motor; "
            f"drive it over {2e3 * travel:.0f} mm or more, or check its encoder"
        )
    if swings < swing:
        raise RecordingError(
            f"the pole swings over {np.degrees(swings):.0f} deg in all: too little to identify it; "
            f"let it swing freely, over {np.degrees(swing):.0f} deg or more, or check its encoder"
        )


def _check_units(episode: Episode) -> None:
    for name, values, counts, unit in (
        ("x", episode.x, episode.counts[:, 0], episode.encoders.metres),
        ("theta", episode.theta, episode.counts[:, 1], episode.encoders.radians),
    ):
        error = values / unit - counts
        turns = (
            np.round((error - error[0]) * unit / (2 * np.pi)) * (2 * np.pi / unit) if name == "theta" else 0
        )
        if np.abs(error - error[0] - turns).max() > TOLERANCE:
            raise RecordingError(
                f"{name} is not its encoder's count times {unit:.4g}; give metres, radians and raw counts"
            )


def _check_encoders(episode: Episode, period: float) -> None:
    """Refuse a count that is constant while the other count or the motor shows that it should change."""
    long = round(FROZEN / period)
    cart, pole = episode.counts[:, 0], episode.counts[:, 1]
    for name, own, other, enough in (
        ("cart", cart, pole, LEAST_SWING / episode.encoders.radians),
        ("pole", pole, cart, MOVES / episode.encoders.metres),
    ):
        for first, last in _standstills(own):
            if last - first < long:
                continue
            pushed = np.mean(np.abs(episode.motor[first:last]) >= STRONG) >= STRONG_SHARE
            if np.ptp(other[first : last + 1]) > enough and (name == "pole" or pushed):
                raise RecordingError(
                    f"the {name}'s count stays at {own[first]} from "
                    f"{first * period:.1f} s to {last * period:.1f} s while the "
                    f"{'pole' if name == 'cart' else 'cart'} moves: "
                    f"the encoder is frozen, saturated or unplugged; check its cable"
                )
    speed = np.abs(np.diff(cart)) * episode.encoders.metres / period
    for first, last in _standstills(cart):
        if last - first >= 5 and first > 0 and speed[first - 1] > SUDDEN_CART:
            raise RecordingError(
                f"the cart stops dead at {cart[first]} counts from "
                f"{speed[first - 1]:.2f} m/s at {first * period:.1f} s: it hit a stop, or its count is "
                "saturated; keep it clear of the ends"
            )


def _standstills(counts: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and last row of each stretch in which a count does not change."""
    edges = np.flatnonzero(np.diff(counts)) + 1
    borders = [0, *edges.tolist(), len(counts)]
    return [(first, last - 1) for first, last in pairwise(borders) if last - first > 1]


def _hangs_still(episode: Episode, period: float) -> bool:
    rows = round(STILL / period)
    angles = wrap(episode.theta - np.pi)
    if len(angles) <= rows:
        return False
    views = np.lib.stride_tricks.sliding_window_view(angles, rows + 1)
    return bool(((np.abs(views).max(1) < STILL_ANGLE) & (np.ptp(views, axis=1) < STILL_SPREAD)).any())


def stays_up(episode: Episode, period: float) -> bool:
    """Return True if the pole is balanced for BALANCED s, about 0: the mean of its angle is upright then."""
    angle = wrap(episode.theta)
    ends = np.concatenate(([-1], np.flatnonzero(np.abs(angle) >= BALANCED_ANGLE), [len(angle)]))
    longest = int(np.diff(ends).argmax())
    balanced = angle[ends[longest] + 1 : ends[longest + 1]]
    return bool(
        len(balanced) * period >= BALANCED
        and abs(balanced.mean()) < BALANCED_MEAN
        and balanced.min() < balanced.mean() - FLICKER
        and balanced.max() > balanced.mean() + FLICKER
    )
