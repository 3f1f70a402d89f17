"""Drive a cart for 10 s with exported weights, without PyTorch.

    cartpole-export run=pretrained/medium format=weights
    python examples/drive_without_torch.py runs/export/<run>/agent.npz /dev/ttyUSB0

The cart homes first; let the pole hang. An agent that observes the pole's length needs it, in m, as a third
argument. `SerialCart` checks the cart, replaces late motor values by 0, sets the motor to 0 and disarms on
every way out.
"""

import math
import signal
import sys
from collections import defaultdict, deque
from pathlib import Path

import numpy as np

from cartpole_rl.errors import CartPoleError, ConfigError, PlantError
from cartpole_rl.exporting.agent import read_agent
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import fault_error
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.wire.messages import Flags, seconds_between

USAGE = "usage: drive_without_torch.py AGENT.npz PORT [POLE_LENGTH]"


def action_values(agent, layers, h):
    """Return the action values of an observation: the formula in cartpole_rl/exporting/agent.py."""
    for layer in layers:
        h = layer.weight @ h + layer.bias
        if layer.gain is not None:
            parts = h.reshape(agent.norm_groups, -1)
            parts = parts - parts.mean(1, keepdims=True)
            parts = parts / np.sqrt((parts**2).mean(1, keepdims=True) + agent.norm_epsilon)
            h = layer.gain * parts.ravel() + layer.shift
        h = h if layer is layers[-1] else np.maximum(h, 0)
    return h


def guarded(agent, motor, now, end):
    """Return `motor`, or full motor inward where the track guard of cartpole_rl/envs/guard.py acts."""
    for guard in agent.guard.each if agent.guard else ():
        too_far_right, too_far_left = (
            side * now["x"] + stopping_distance(guard, now, side) > end for side in (1, -1)
        )
        if too_far_right != too_far_left:
            return min(0, *agent.motors) if too_far_right else max(0, *agent.motors)
    return motor


def stopping_distance(guard, now, side):
    """Return the way, m, that the cart runs on to one side, 1 or -1, under full motor to the other one."""
    x_dot = side * now["x_dot"]
    way = guard.margin + guard.delay * x_dot
    if guard.pole is None:
        return way + x_dot * abs(x_dot) / (2 * guard.deceleration)
    length = guard.pole.length or now["pole_length"]
    mass = 1 + guard.pole.density * length
    reach = (mass - 1) / mass * length / 2
    centre = x_dot + side * reach * now["cos_theta"] * now["theta_dot"]
    way += guard.pole.swing * reach * (1 + side * now["sin_theta"])
    return way + mass * centre * abs(centre) / (2 * guard.deceleration)


def check_cart(cart, state):
    """Raise PlantError if the cart latched a fault, was disarmed, or left its track."""
    if state.fault:
        raise fault_error(state.fault)
    if Flags.ARMED not in cart.flags:
        raise PlantError("the cart is not armed any more: it has restarted; check its power")
    if abs(state.cart_counts) >= cart.information.soft_limit_counts:
        raise PlantError("the cart left its track: push it back, and start again")


def drive(cart, agent, layers, pole_length, seconds):
    """Drive for some seconds, then stop the cart; return how long the pole stood at the end, in s.

    Raises PlantError where the drive cannot go on; the motor is then 0.
    """
    cart.start()
    try:
        return drive_armed(cart, agent, layers, pole_length, seconds)
    finally:
        cart.stop()


def drive_armed(cart, agent, layers, pole_length, seconds):
    """Drive a cart that is armed; see `drive`."""
    metre, turn = agent.cart_metres_per_count, agent.pole_counts_per_turn
    end = cart.information.soft_limit_counts * metre
    history = deque([defaultdict(float)] * 17, 17)  # what was measured and sent, newest first
    last, upright = None, 0.0
    for _ in range(round(seconds / agent.control_period)):
        state = cart.get_state()
        check_cart(cart, state)
        if last and (Flags.SOFT_LIMIT in cart.flags or not cart.took_motor(state)):
            history[0]["motor"] = state.motor_applied  # the cart replaced or lost what was sent
        dt = seconds_between(last.time_us, state.time_us) if last else agent.control_period
        cart.check_suspension(dt)
        cart_step = state.cart_counts - last.cart_counts if last else 0
        pole_step = state.pole_counts - last.pole_counts if last else 0
        theta = ((state.pole_counts + turn // 2) % turn - turn // 2) * 2 * math.pi / turn
        now = {"x": state.cart_counts * metre, "x_dot": cart_step * metre / dt, "theta": theta}
        now |= {"theta_dot": pole_step * 2 * math.pi / turn / dt}
        now |= {"cos_theta": math.cos(theta), "sin_theta": math.sin(theta), "pole_length": pole_length}
        if agent.angle_limit is not None and abs(theta) > agent.angle_limit:
            raise PlantError("the pole fell")
        history.appendleft(now)
        observation = [history[each.periods_ago][each.name] / each.scale for each in agent.numbers]
        values = action_values(agent, layers, np.array(observation, np.float32))
        if not np.isfinite([*observation, *values]).all():
            raise PlantError("an observation or an action value is not finite; export another agent")
        motor = guarded(agent, agent.motors[values.argmax()], now, end)
        now["motor"] = cart.set_motor(motor)
        last, upright = state, upright + dt if abs(theta) < math.radians(5) else 0.0
    return upright


def length_of(text, agent):
    """Return the pole's length in m. Raises ConfigError if the agent observes it and it is not given in m."""
    try:
        length = float(text)
    except ValueError:
        raise ConfigError(f"POLE_LENGTH: {text!r} is not a number of metres") from None
    if agent.observation.pole_length and not 0 < length <= 3:
        raise ConfigError(f"this agent observes the pole's length, give it in m, at most 3; {USAGE}")
    return length


def main(file, port, pole_length="0"):
    """Read an agent, drive the cart on a port, and print how long the pole stood."""
    exported = read_agent(Path(file))  # checks the whole file
    agent = exported.description
    if agent.start == "upright":
        raise ConfigError("this agent needs an upright pole, and here it hangs; give an agent that swings up")
    length = length_of(pole_length, agent)
    with SerialCart(SerialSettings(port=port), hardware_of(agent.hardware)) as cart:
        cart.home()
        cart.set_period(round(agent.control_period * 1e6))
        upright = drive(cart, agent, exported.layers, length, 10)
    print(f"upright for the last {upright:.2f} s")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(USAGE)
    RaiseOnce(lambda number: SystemExit(128 + number)).handle(signal.SIGINT, *ending_signals())
    try:
        main(*sys.argv[1:])
    except CartPoleError as error:
        sys.exit(str(error))
