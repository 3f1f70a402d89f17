"""The emulated cart's physics: a MuJoCo model of a cart on a rail with a pole, stepped at 1 kHz or finer.

Coordinates: x in m from the middle of the rail, angle in rad from upright; both positive to the right. A
tilt of the rail is a rotation of gravity, so MuJoCo's joint angle, which is measured from the normal of the
rail, is the angle minus the tilt. Dry friction is MuJoCo's friction loss, made almost rigid (with the soft
default a cart at rest would creep); the stops are stiff joint limits.
Where the rig has an end switch, the track ends there, and a stop lies a little behind it.
"""

import math
from collections.abc import Callable
from types import ModuleType

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError
from cartpole_rl.rig.hardware import LARGEST_MOTOR, nominal_hardware

GRAVITY = 9.81  # m/s^2
LEAST_FELT = 1e-6  # share of the pole's force
STOP_BEHIND = 0.005  # m from where an end switch is pressed to the stop: a homing cart runs on for 3 mm
HYSTERESIS = 0.001  # m inward of where it is pressed, an end switch is released
AT_REST = 1e-4  # m/s; below this speed the breakaway friction applies
MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option integrator="Euler" tolerance="1e-14">
    <flag contact="disable"/>
  </option>
  <default>
    <joint solreffriction="0.003 1" solimpfriction="0.9999 0.9999 0.001"
           solreflimit="0.003 1" solimplimit="0.99 0.9999 0.0001"/>
  </default>
  <worldbody>
    <body>
      <joint type="slide" axis="1 0 0" range="{left_stop} {right_stop}"/>
      <inertial pos="0 0 0" mass="{cart_mass}" diaginertia="0.001 0.001 0.001"/>
      <body>
        <joint type="hinge" axis="0 1 0" damping="{pole_viscous}" frictionloss="{pole_coulomb}"/>
        <inertial pos="0 0 {pole_com}" mass="{pole_mass}"
                  diaginertia="{pole_inertia} {pole_inertia} {thin_inertia}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def load_mujoco() -> ModuleType:
    """Return the mujoco package. Raises EmulatorError if it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise EmulatorError(
            'the emulated cart needs MuJoCo, which is not installed: pip install "cartpole_rl[emulator]"'
        ) from None
    return mujoco


class Motor:
    """From a motor value to the force on the cart: a first-order lag behind a static force curve."""

    def __init__(self, settings: EmulatorSettings) -> None:
        self._settings = settings
        self.force = 0.0  # N, positive to the right

    def static_force(self, motor: int) -> float:
        """Return the steady force of a motor value, N."""
        settings = self._settings
        size = abs(motor)
        if size <= (settings.deadband_right if motor > 0 else settings.deadband_left):
            return 0.0
        a, b, c = settings.force_curve
        force = max(0.0, a * size * size + b * size + c)
        return force * (1 + settings.force_asymmetry) if motor > 0 else -force

    def friction_share(self, motor: int) -> float:
        """Return the share of the cart's viscous friction at a motor value: less of it than at full motor."""
        off = 1 - abs(motor) / LARGEST_MOTOR
        return 1 - self._settings.coasting * off

    def decay(self, seconds: float) -> float:
        """Return the share of the gap to the steady force that is left after `seconds`."""
        lag = self._settings.motor_time_constant
        return math.exp(-seconds / lag) if lag else 0.0

    def step(self, target: float, decay: float) -> float:
        """Approach the steady force `target`, N, up to the share `decay` of the gap; return the force, N."""
        self.force = target + (self.force - target) * decay
        return self.force


class CartPhysics:
    """One cart and its pole, at rest in the middle with the pole hanging until it is placed."""

    def __init__(self, settings: EmulatorSettings) -> None:
        mujoco = load_mujoco()
        thin = settings.pole_inertia * 1e-3  # about the pole's own axis, about which nothing rotates
        # A motor that feels a share of the pole moves as a cart that is so much heavier, under larger forces.
        self._larger = larger = 1 / max(settings.backdrivability, LEAST_FELT)
        rig, half = settings.hardware or nominal_hardware(), settings.track_half_length
        self._left_stop = -half - STOP_BEHIND * rig.left_switch
        self._right_stop = half + STOP_BEHIND * rig.right_switch
        self._rig_switches = rig.switches  # end switches, as bits: 1 left, 2 right
        self.switches = 0  # those that the cart presses
        numbers = settings.model_dump() | {
            "left_stop": self._left_stop,
            "right_stop": self._right_stop,
            "cart_mass": larger * settings.cart_mass,
        }
        self._viscous = larger * settings.cart_viscous  # N s/m at full motor
        model = MODEL.format(thin_inertia=thin, **numbers)
        self._model = mujoco.MjModel.from_xml_string(model)
        tilt = settings.track_tilt
        # N, against the larger weight
        self._held = (1 - larger) * settings.cart_mass * GRAVITY * math.sin(tilt)
        self._model.opt.gravity[:] = (GRAVITY * math.sin(tilt), 0.0, -GRAVITY * math.cos(tilt))
        self._data = mujoco.MjData(self._model)
        self._mj_step = mujoco.mj_step
        self._settings = settings
        self._motor = Motor(settings)
        self.on_contact: Callable[[float], None] | None = None  # called with the speed in m/s at an end stop
        self._touches = False
        self.place(0.0, math.pi)

    @property
    def x(self) -> float:
        """Cart position, m from the middle of the rail."""
        return self._data.qpos.item(0)

    @property
    def x_dot(self) -> float:
        """Cart velocity, m/s."""
        return self._data.qvel.item(0)

    @property
    def angle(self) -> float:
        """Pole angle, rad from the vertical, not wrapped."""
        return self._data.qpos.item(1) + self._settings.track_tilt

    @property
    def position(self) -> tuple[float, float]:
        """`x` and `angle`, read at once."""
        x, angle = self._data.qpos.tolist()
        return x, angle + self._settings.track_tilt

    @property
    def angle_dot(self) -> float:
        """Pole angular velocity, rad/s."""
        return self._data.qvel.item(1)

    def place(self, x: float, angle: float, angle_dot: float = 0.0) -> None:
        """Place the cart at x m, at rest, and the pole at an angle and angular velocity, rad and rad/s."""
        self._data.qpos[0] = x
        self._data.qvel[0] = 0.0
        self._press_switches(x)
        self.place_pole(angle, angle_dot)

    def place_pole(self, angle: float, angle_dot: float = 0.0) -> None:
        """Place the pole at an angle and angular velocity, rad and rad/s; do not move the cart."""
        self._data.qpos[1] = angle - self._settings.track_tilt
        self._data.qvel[1] = angle_dot

    def advance(self, motor: int, seconds: float, look: Callable[[float], int] | None = None) -> None:
        """Simulate `seconds` under one motor value, in equal steps of at most `physics_step`.

        `look`, called with the seconds passed after each step, returns the motor value from there on.
        """
        steps = math.ceil(seconds / self._settings.physics_step - 1e-9)
        if steps == 0:
            return
        step = seconds / steps
        model, data, drag = self._model, self._data, self._settings.pole_drag
        position, speed, applied, friction = data.qpos, data.qvel, data.qfrc_applied, model.dof_frictionloss
        model.opt.timestep = step
        decay = self._motor.decay(step)
        target, x = self._enforce(motor), self.x
        for number in range(1, steps + 1):
            x_dot, angle_dot = speed.tolist()
            applied[0] = self._larger * (self._motor.step(target, decay) + self._cogging(x)) + self._held
            applied[1] = -drag * angle_dot * abs(angle_dot)
            friction[0] = self._cart_friction(x_dot)
            self._mj_step(model, data)
            x = position.item(0)
            self._notice_contact(x, x_dot)
            self._press_switches(x)
            if look is not None and (chosen := look(number * step)) != motor:
                motor, target = chosen, self._enforce(chosen)

    def _enforce(self, motor: int) -> float:
        """Set the cart's viscous friction at a motor value; return the steady force, N."""
        self._model.dof_damping[0] = self._viscous * self._motor.friction_share(motor)
        return self._motor.static_force(motor)

    def _notice_contact(self, x: float, x_dot: float) -> None:
        """Report it if the cart, now at `x` m, has just touched an end stop, at `x_dot` m/s."""
        touches = not self._left_stop < x < self._right_stop
        if touches and not self._touches and self.on_contact is not None:
            self.on_contact(abs(x_dot))
        self._touches = touches

    def _press_switches(self, x: float) -> None:
        """Press the switches that the rig has, at the ends of the track."""
        if self._rig_switches:
            half = self._settings.track_half_length
            left = -x >= half - HYSTERESIS * (self.switches & 1)
            right = x >= half - HYSTERESIS * (self.switches >> 1)
            self.switches = self._rig_switches & (left + 2 * right)

    def _cogging(self, x: float) -> float:
        """Return the cogging force, which pulls the cart to the nearest stable position, N."""
        cogging = self._settings.cogging
        return -cogging * math.sin(math.tau * x / self._settings.cogging_pitch) if cogging else 0.0

    def _cart_friction(self, x_dot: float) -> float:
        """Return the largest dry friction that the rail can exert now, N."""
        settings = self._settings
        at_rest = abs(x_dot) < AT_REST
        pull = self._data.qacc_smooth[0] if at_rest else x_dot  # at rest: the direction of all other forces
        coulomb = settings.cart_coulomb_right if pull > 0 else settings.cart_coulomb_left
        return self._larger * coulomb * (settings.cart_stiction_ratio if at_rest else 1.0)
