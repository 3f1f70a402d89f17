"""Cuts episodes into short windows, each with its own unknown initial state.

A prediction over a whole swing-up forgets its initial state: an error doubles every tenth of a second near
upright. Half a second is long enough for parameters to show and short enough for a search to converge.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.tasks.episode import IRREGULAR, Episode

WINDOW = 0.5  # s, of the windows that a cart is fitted to
HISTORY, LEAST_HISTORY = 0.24, 6  # s and periods of motor values before a window: what a residual reads
JUDGING = 4  # one window in so many judges models that are fitted to the others
LEAST_LEAD = 5  # periods whose positions give an initial state
HELD_OUT_OF = 5  # one recording in so many is held out
HELD_OUT_LEAD = 0.2  # s of a held-out window that give its initial state
UNEVEN = IRREGULAR + 0.01  # the same where stamps are rounded to whole milliseconds


class NoWindowError(RecordingError):
    """Every recording is too short, or its frames are lost too often."""


@contextmanager
def naming(file: str) -> Iterator[None]:
    """Put the name of a file before the message of a RecordingError."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(f"{file}: {error}") from None


class Windows(NamedTuple):
    """W windows of T periods, with the motor values of the H periods before them."""

    positions: NDArray[np.float64]  # [T + 1, 2, W] m and rad: cart and pole, as their encoders count
    motors: NDArray[np.float64]  # [H + T, W] motor values chosen, oldest first
    episode: NDArray[np.int64]  # [W] number of the episode of each
    first: NDArray[np.int64]  # [W] row of that episode at which each starts
    resolution: NDArray[np.float64]  # [2] m and rad of a count
    lead: int = 0  # periods at the start of each that give its initial state and are not predicted

    @property
    def periods(self) -> int:
        """T."""
        return len(self.positions) - 1

    @property
    def number(self) -> int:
        """W."""
        return self.positions.shape[2]

    def share_frames(self, other: "Windows") -> bool:
        """Return True if a window includes a frame of `other`, which is a single one."""
        within = (self.first <= other.first + other.periods) & (self.first + self.periods >= other.first)
        return bool((within & (self.episode == other.episode)).any())


def joined(windows: Sequence[Windows]) -> Windows:
    """Return windows of one length and lead together, in their order."""
    positions, motors, episode, first = (
        np.concatenate([each[part] for each in windows], -1) for part in range(4)
    )
    return Windows(positions, motors, episode, first, windows[0].resolution, windows[0].lead)


def history_periods(period: float) -> int:
    """Return the number H of motor values before a window, at a control period in s."""
    return max(LEAST_HISTORY, math.ceil(HISTORY / period - 1e-9))


def lead_periods(seconds: float, period: float) -> int:
    """Return the number of periods in a lead of about `seconds`."""
    return max(LEAST_LEAD, round(seconds / period))


def cut_windows(
    episodes: Sequence[Episode],
    period: float,
    seconds: float = WINDOW,
    most: int = 240,
    apart_from: Windows | None = None,
) -> Windows:
    """Cut windows of `seconds` s, one after another, evenly thinned to at most `most`.

    A window over a lost or late frame is left out, and so is one that shares frames with `apart_from`. Raises
    RecordingError if nothing is left. `period`, s, is that of the recordings (`checks.shared_period`).
    """
    periods = round(seconds / period)
    pieces = [
        piece
        for number, episode in enumerate(episodes)
        for piece in _pieces(episode, period, periods, step=periods, least=periods, number=number)
        if apart_from is None or not apart_from.share_frames(piece)
    ]
    if not pieces:
        if all(episode.measured_steps < periods for episode in episodes):
            raise NoWindowError(f"no recording lasts {periods * period:g} s: record longer")
        raise NoWindowError(
            f"no recording holds {periods * period:g} s without a lost frame: record longer, check the cable"
        )
    chosen = np.unique(np.linspace(0, len(pieces) - 1, min(most, len(pieces))).round().astype(int))
    return joined([pieces[index] for index in chosen])


def cut_stretches(episode: Episode, period: float, seconds: float, lead: int) -> Windows:
    """Cut a window of `lead` periods and `seconds` s at every `seconds` s of an episode.

    Positions are NaN from the first lost or late frame on; a window with such a frame in its lead is left
    out. Raises RecordingError where nothing is left.
    """
    periods = max(1, round(seconds / period))
    pieces = [*_pieces(episode, period, lead + periods, step=periods, least=lead + 1)]
    if not pieces:
        raise RecordingError(
            f"a recording of {episode.steps * period:.2f} s is too short to be replayed, or its frames are "
            "late or lost"
        )
    return joined(pieces)._replace(lead=lead)


def cut_judging(
    episodes: Sequence[Episode], period: float, seconds: float, lead: int, moving: float
) -> Windows:
    """Cut a window of `lead` periods and `seconds` s at every `seconds` s, and keep every JUDGING-th of them.

    Only those count in which the cart moves over `moving` m or more and no frame is lost or late.
    Raises RecordingError where there are none.
    """
    periods = round(seconds / period)
    pieces = [
        piece
        for number, episode in enumerate(episodes)
        for piece in _pieces(episode, period, lead + periods, periods, lead + periods, number)
        if np.ptp(piece.positions[:, 0]) >= moving
    ]
    if not pieces:
        held = f"moves the cart over {moving:g} m within" if moving else "holds"
        raise RecordingError(
            f"no recording {held} {seconds:g} s without a lost frame: record longer"
            f"{', drive it more' if moving else ''}, or check the cable"
        )
    return joined(pieces[(JUDGING - 1) % len(pieces) :: JUDGING])._replace(lead=lead)


def _pieces(
    episode: Episode, period: float, length: int, step: int, least: int, number: int = 0
) -> Iterator[Windows]:
    """Yield single windows of `length` periods, every `step`, whose history and first `least` are known."""
    history, end = history_periods(period), episode.measured_steps
    late = np.flatnonzero(~episode.regular_frames(period)[:end])
    last_known = np.append(late, end)  # rows after which the motion is not known
    before = np.zeros(history)
    if known_before := episode.motor_before[-history:]:
        before[-len(known_before) :] = known_before
    motors = np.concatenate((before, episode.motor.astype(np.float64), np.zeros(length)))
    every = episode.positions
    resolution = np.array(episode.encoders.resolution)
    for first in range(0, end - least + 1, step):
        known = last_known[np.searchsorted(last_known, max(0, first - history))] - first
        if known >= least:
            positions = np.full((length + 1, 2), np.nan)
            measured = every[first : first + min(known, length) + 1]
            positions[: len(measured)] = measured
            driven = motors[first : first + history + length, None]
            yield Windows(positions[..., None], driven, np.array([number]), np.array([first]), resolution)


def mean_gap(time: NDArray[np.float64]) -> float:
    """Return the mean gap between times, s, of gaps that are near the median; to four digits.

    It is the median if none is.
    """
    gaps = np.diff(time)
    median = np.median(gaps)
    near = gaps[np.abs(gaps - median) <= UNEVEN * median]
    return float(f"{near.mean() if near.size else median:.4g}")


def hold_out(episodes: Sequence[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Return episodes to learn from and held-out ones: every fifth, or the last fifth of each of a few."""
    if len(episodes) >= HELD_OUT_OF:
        chosen = range(HELD_OUT_OF // 2, len(episodes), HELD_OUT_OF)
        return (
            [episode for number, episode in enumerate(episodes) if number not in chosen],
            [episodes[number] for number in chosen],
        )
    ends = [episode.steps - episode.steps // HELD_OUT_OF for episode in episodes]
    return (
        [episode.part(0, end) for episode, end in zip(episodes, ends, strict=True)],
        [episode.part(end, episode.steps) for episode, end in zip(episodes, ends, strict=True)],
    )


def held_out_windows(episodes: Sequence[Episode], period: float, horizon: float) -> Windows:
    """Return windows of a lead and `horizon` s, overlapping by half.

    The motor values before each window are those of its episode. `Windows.episode` counts the episodes, then
    the same without the first half window. Raises RecordingError if there is no window.
    """
    history, lead = history_periods(period), lead_periods(HELD_OUT_LEAD, period)
    ahead = lead + round(horizon / period)
    later = [episode.part(min((history + ahead) // 2, episode.steps), episode.steps) for episode in episodes]
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
