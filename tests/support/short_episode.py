"""A recorded episode of two control periods."""

import numpy as np

from cartpole_rl.tasks.episode import Episode

EPISODE = Episode(
    time=0.02 * np.arange(3),
    x=np.array([0.0, 0.1, 1 / 3]),
    x_dot=np.zeros(3),
    theta=np.full(3, np.pi),
    theta_dot=np.zeros(3),
    counts=np.arange(6).reshape(3, 2),
    motor=np.array([100, -100]),
    score=np.ones(2),
    score_upright=np.ones(2),
    reward=np.ones(2),
    ended_by="time",
)
