"""Episodes of a simple cart that swings its pole up by energy and balances it by linear feedback."""

import math

import numpy as np
import pytest
from small_study import edit as edit
from small_study import made as made
from small_study import study as study

from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.tasks.episode import Episode

PERIOD = 0.02  # s
SUBSTEPS = 20
GRAVITY = 9.81
COM = 0.1778  # m, pivot to centre of mass of a uniform rod
CART, POLE = 0.57, 0.127  # kg
TRACK = 0.407  # m
FULL_FORCE = 6.0  # N at motor value 255
LEVELS = np.array([-250, -200, -150, -100, 0, 100, 150, 200, 250])  # motor values


def accelerations(theta: float, theta_dot: float, force: float) -> tuple[float, float]:
    """Equations (3.6) and (3.5), k = 1/3: m/s2 and rad/s2."""
    total, sine, cosine = CART + POLE, math.sin(theta), math.cos(theta)
    push = force + POLE * COM * theta_dot**2 * sine
    theta_dd = (total * GRAVITY * sine - cosine * push) / (4 / 3 * total * COM - POLE * COM * cosine**2)
    return (push - POLE * COM * theta_dd * cosine) / total, theta_dd


def choose_force(x: float, x_dot: float, theta: float, theta_dot: float) -> float:
    """Pump energy while the pole hangs, balance once it is near the top; N."""
    lean = (theta + math.pi) % (2 * math.pi) - math.pi
    if abs(lean) < 0.45:
        return 32 * lean + 4.5 * theta_dot + 4 * x + 7 * x_dot
    lacking = (
        1.2 - math.cos(lean) - 0.5 * 4 / 3 * COM * theta_dot**2 / GRAVITY
    )  # energy in m g l, with a margin
    return -0.6 * lacking * theta_dot * math.cos(lean) - 10 * x


def drive(theta: float, seconds: float, loss_of_control: float = math.inf) -> Episode:
    """From angle `theta` (rad), for `seconds`; from `loss_of_control` s on the motor sticks at full right."""
    state = np.array([0.0, 0.0, theta, 0.0])
    rows, motors, ended_by = [state.copy()], [], "time"
    for step in range(round(seconds / PERIOD)):
        target = choose_force(*state) if step * PERIOD < loss_of_control else FULL_FORCE
        motors.append(int(LEVELS[np.abs(LEVELS - target / FULL_FORCE * 255).argmin()]))
        for _ in range(SUBSTEPS):
            force = motors[-1] / 255 * FULL_FORCE - 1.0 * state[1]
            x_dd, theta_dd = accelerations(state[2], state[3], force)
            state[1] += x_dd * PERIOD / SUBSTEPS
            state[3] += theta_dd * PERIOD / SUBSTEPS
            state[0] += state[1] * PERIOD / SUBSTEPS
            state[2] += state[3] * PERIOD / SUBSTEPS
        rows.append(state.copy())
        if abs(state[0]) > TRACK:
            ended_by = "track"
            break
    return as_episode(np.array(rows), np.array(motors, dtype=np.int64), ended_by)


def as_episode(states: np.ndarray, motor: np.ndarray, ended_by: str) -> Episode:
    """States [T+1, 4] with their scores."""
    x, x_dot, theta, theta_dot = states.T
    lean = np.abs((theta[1:] + math.pi) % (2 * math.pi) - math.pi)
    upright = np.cos(lean / 2) * (1 - np.abs(x[1:]) / TRACK).clip(min=0)
    near = lean < math.radians(5)
    score = upright + 5.0 * near + 5.0 * (near & (np.abs(theta_dot[1:]) < math.radians(6)))
    return Episode(
        time=np.arange(len(x)) * PERIOD,
        x=x,
        x_dot=x_dot,
        theta=theta,
        theta_dot=theta_dot,
        counts=np.rint(np.stack((x, theta), 1) / nominal_encoders().resolution).astype(int),
        motor=motor,
        score=score,
        score_upright=upright,
        reward=score,
        ended_by=ended_by,
    )


@pytest.fixture(scope="session")
def swing_up() -> Episode:
    """Ten seconds from near hanging."""
    return drive(math.pi - 0.35, 10.0)


@pytest.fixture(scope="session")
def balance() -> Episode:
    """Ten seconds from 3 degrees."""
    return drive(math.radians(3), 10.0)


@pytest.fixture(scope="session")
def runaway() -> Episode:
    """From hanging, with a motor that sticks after 6.2 seconds, until the cart leaves the track."""
    return drive(math.pi - 0.35, 10.0, loss_of_control=6.2)


@pytest.fixture(scope="session")
def replay(swing_up: Episode) -> Replayed:
    """Nine stretches of 1 s, 20 mm and 3 degrees off; the last one ends after 0.6 s."""
    rows = np.arange(0, 450, 50)[:, None] + np.arange(51)
    known = np.ones(rows.shape)
    known[-1, 30:] = math.nan
    return Replayed(
        swing_up,
        swing_up.time[rows],
        swing_up.x[rows] + 0.02 * known,
        swing_up.theta[rows] + math.radians(3) * known,
        0.02 * known,
        math.radians(3) * known,
    )
