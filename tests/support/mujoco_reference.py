"""A frictionless cart and pole in MuJoCo, written without any of the package's equations.

The hinge counts from the track's normal; a tilt of the track is a turn of gravity.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4" timestep="{step}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="{cart_mass}" diaginertia="1 1 1"/>
      <body>
        <joint type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 {pole_com}" mass="{pole_mass}" diaginertia="{pole_inertia} {pole_inertia} 1e-6"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class MujocoCart:
    """A cart in SI units; `tilt` is positive where the right end of the track is lower."""

    cart_mass: float
    pole_mass: float
    pole_com: float
    pole_inertia: float
    tilt: float = 0.0
    gravity: float = 9.81

    def run(self, start: np.ndarray, force: float, seconds: float, step: float = 1e-3) -> np.ndarray:
        """State (x, x_dot, theta, theta_dot) after `seconds` from `start` under a constant `force`."""
        model = mujoco.MjModel.from_xml_string(MODEL.format(step=step, **vars(self)))
        model.opt.gravity[:] = (self.gravity * math.sin(self.tilt), 0, -self.gravity * math.cos(self.tilt))
        data = mujoco.MjData(model)
        data.qpos[:] = start[0], start[2] - self.tilt
        data.qvel[:] = start[1], start[3]
        data.qfrc_applied[0] = force
        for _ in range(round(seconds / step)):
            mujoco.mj_step(model, data)
        (x, angle), (x_dot, angle_dot) = data.qpos, data.qvel
        return np.array([x, x_dot, angle + self.tilt, angle_dot])
