"""A recorded episode of two control periods, and one with all that a recording can hold."""

from dataclasses import replace

import numpy as np

from cartpole_rl.rig.hardware import Encoders
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
FULL = replace(
    EPISODE,
    x_dot=np.array([-0.0, 5e-324, 0.1 + 0.2]),
    counts=np.array([[-(2**31), 2**31 - 1], [0, 1], [2, 3]]),
    reward=np.array([-1 / 3, 1e-17]),
    ended_by="fault",
    guarded=np.array([False, True]),
    encoders=Encoders(85e-6, 4271),
    motor_before=(7, -8),
    left_out="a count jumped: the last 1 of 3 control periods do not count",
)
