"""Drive a cart for 10 s with exported weights, without PyTorch.

    cartpole-export run=pretrained/medium format=weights
    python examples/drive_without_torch.py runs/export/<run>/agent.npz /dev/ttyUSB0

The cart homes first; let the pole hang. `SerialCart` checks the cart, replaces late motor values by 0, sets
the motor to 0 and disarms on every way out. An agent that observes the pole's length needs it in `now`.
"""

import math
import sys
from collections import defaultdict, deque
from pathlib import Path

import numpy as np

from cartpole_rl.exporting.weights import read_agent
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.wire import Flags, seconds_between


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


def guarded(agent, motor, x, x_dot, end):
    """Return `motor`, or full motor inward where the track guard of cartpole_rl/envs/guard.py acts."""
    side, guard = 0, agent.guard
    for way in (1, -1) if guard else ():
        braking = guard.delay * x_dot + x_dot * abs(x_dot) / (2 * guard.deceleration)
        side += way * (way * (x + braking) + guard.margin > end)
    return {0: motor, 1: min(0, *agent.motors), -1: max(0, *agent.motors)}[side]


def drive(cart, agent, layers, seconds):
    """Drive until the time is over, or the cart leaves its track or stops; return how long the pole stood."""
    metre, turn = agent.cart_metres_per_count, agent.pole_counts_per_turn
    limit = cart.information.soft_limit_counts
    history = deque([defaultdict(float)] * 17, 17)  # what was measured and sent, newest first
    cart.start()
    last, upright = None, 0.0
    for _ in range(round(seconds / agent.control_period)):
        state = cart.get_state()
        dt = seconds_between(last.time_us, state.time_us) if last else agent.control_period
        cart_step = state.cart_counts - last.cart_counts if last else 0
        pole_step = state.pole_counts - last.pole_counts if last else 0
        theta = ((state.pole_counts + turn // 2) % turn - turn // 2) * 2 * math.pi / turn
        now = {"x": state.cart_counts * metre, "x_dot": cart_step * metre / dt, "theta": theta}
        now |= {"theta_dot": pole_step * 2 * math.pi / turn / dt}
        now |= {"cos_theta": math.cos(theta), "sin_theta": math.sin(theta)}
        history.appendleft(now)
        observation = [history[each.periods_ago][each.name] / each.scale for each in agent.numbers]
        values = action_values(agent, layers, np.array(observation, np.float32))
        if abs(state.cart_counts) >= limit or Flags.ARMED not in cart.flags or not np.isfinite(values).all():
            break
        motor = guarded(agent, agent.motors[values.argmax()], now["x"], now["x_dot"], limit * metre)
        now["motor"] = cart.set_motor(motor)
        last, upright = state, upright + dt if abs(theta) < math.radians(5) else 0.0
    return upright


if __name__ == "__main__":
    exported = read_agent(Path(sys.argv[1]))  # checks the whole file
    RaiseOnce(lambda number: SystemExit(128 + number)).handle(*ending_signals())
    with SerialCart(SerialSettings(port=sys.argv[2])) as cart:
        cart.home()
        cart.set_period(round(exported.description.control_period * 1e6))
        print(f"upright for the last {drive(cart, exported.description, exported.layers, 10):.2f} s")
