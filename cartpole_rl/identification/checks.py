"""Checks of recordings before a cart is fitted to them. A message says what is wrong and what to do.

A fit returns a cart for any data. These checks refuse data that no cart could have produced.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.correlation import correlation
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.floating]
SHORTEST = 20.0  # s
LEAST_TRAVEL, LEAST_SWING = 0.05, 0.35  # m, rad
STILL, STILL_ANGLE, STILL_SPREAD = 0.3, 0.2, 0.02  # s, rad from hanging, rad
FROZEN = 1.0  # s
STRONG, MOVES = 150, 0.03  # motor value; m of cart that move a hanging pole
SUDDEN = 0.25  # m/s: from here to standing exactly still within a period
TOLERANCE = 2.0  # counts by which positions in SI units may differ from counts
SIGNIFICANT = 0.2  # correlation from which its sign is certain


def check_recordings(episodes: Sequence[Episode], period: float) -> None:
    """Raise RecordingError for the first problem."""
    seconds = period * sum(episode.steps for episode in episodes)
    if seconds < SHORTEST:
        raise RecordingError(f"{seconds:.1f} s of recordings are too short; record {SHORTEST:g} s or more")
    for number, episode in enumerate(episodes):
        _check_units(episode, number)
    travel = max(float(np.ptp(episode.x)) for episode in episodes)
    swing = max(float(np.ptp(episode.theta)) for episode in episodes)
    if travel < LEAST_TRAVEL or not any(episode.motor.any() for episode in episodes):
        raise RecordingError(
            f"the cart moves {1e3 * travel:.0f} mm in all: too little to identify its friction and motor; "
            "drive it over 100 mm or more"
        )
    for number, episode in enumerate(episodes):
        _check_encoders(episode, number, period)
    if swing < LEAST_SWING:
        raise RecordingError(
            f"the pole swings over {np.degrees(swing):.0f} deg in all: too little to identify it; "
            "let it swing freely, over 20 deg or more"
        )
    if not any(_hangs_still(episode, period) for episode in episodes):
        raise RecordingError(
            "the pole never hangs still in the recordings, so its zero cannot be checked; "
            "start one with half a second of the pole at rest"
        )
    _check_signs(episodes, period)


def _check_units(episode: Episode, number: int) -> None:
    for name, values, counts, unit in (
        ("x", episode.x, episode.counts[:, 0], CART_METRES_PER_COUNT),
        ("theta", episode.theta, episode.counts[:, 1], POLE_RADIANS_PER_COUNT),
    ):
        error = values / unit - counts
        turns = (
            np.round((error - error[0]) * unit / (2 * np.pi)) * (2 * np.pi / unit) if name == "theta" else 0
        )
        if np.abs(error - error[0] - turns).max() > TOLERANCE:
            raise RecordingError(
                f"recording {number}: {name} is not its encoder's count times {unit:.4g}; "
                "give metres, radians and raw counts"
            )


def _check_encoders(episode: Episode, number: int, period: float) -> None:
    """Refuse a count that is constant while the other count or the motor shows that it should change."""
    long = round(FROZEN / period)
    cart, pole = episode.counts[:, 0], episode.counts[:, 1]
    for name, own, other, enough in (
        ("cart", cart, pole, LEAST_SWING / POLE_RADIANS_PER_COUNT),
        ("pole", pole, cart, MOVES / CART_METRES_PER_COUNT),
    ):
        for first, last in _standstills(own):
            if last - first < long:
                continue
            pushed = np.abs(episode.motor[first:last]).min() >= STRONG
            if np.ptp(other[first : last + 1]) > enough and (name == "pole" or pushed):
                raise RecordingError(
                    f"recording {number}: the {name}'s count stays at {own[first]} from "
                    f"{first * period:.1f} s to {last * period:.1f} s while the "
                    f"{'pole' if name == 'cart' else 'cart'} moves: "
                    f"the encoder is frozen, saturated or unplugged; check its cable"
                )
    speed = np.abs(np.diff(cart)) * CART_METRES_PER_COUNT / period
    for first, last in _standstills(cart):
        if last - first >= 5 and first > 0 and speed[first - 1] > SUDDEN:
            raise RecordingError(
                f"recording {number}: the cart stops dead at {cart[first]} counts from "
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


def _check_signs(episodes: Sequence[Episode], period: float) -> None:
    """Refuse signs by which the motor pushes the cart backwards, or a hanging pole leads its cart."""
    pushes, responses, jerks, lags = [], [], [], []
    for episode in episodes:
        if episode.steps < 10:
            continue
        x_ddot, theta_ddot = (np.diff(values[::3], n=2) for values in (episode.x, episode.theta))
        motor = np.convolve(episode.motor, np.ones(3) / 3, "valid")[::3]
        rows = min(len(x_ddot), len(motor) - 1)
        pushes.append(motor[1 : rows + 1] if len(motor) > rows else motor[:rows])
        responses.append(x_ddot[:rows])
        angle = wrap(episode.theta[::3][1:-1] - np.pi)
        hanging = np.abs(angle[:rows]) < 0.8
        free = theta_ddot[:rows] + (3 * period) ** 2 * 40 * np.sin(angle[:rows])  # without gravity
        jerks.append(x_ddot[:rows][hanging])
        lags.append(free[hanging])
    if _correlation(pushes, responses) < -SIGNIFICANT:
        raise RecordingError(
            "positive motor values push the cart towards smaller counts: swap the motor's wires, or the "
            "cart encoder's channels"
        )
    if _correlation(jerks, lags) < -SIGNIFICANT:
        raise RecordingError(
            "the pole runs ahead of its cart instead of staying behind: swap the pole encoder's channels"
        )


def _correlation(first: Sequence[Array], second: Sequence[Array]) -> float:
    a, b = np.concatenate(first), np.concatenate(second)
    return correlation(a, b) if len(a) > 10 else 0.0
