#!/usr/bin/env python
"""Does a cart with a policy on the board swing its pole up by itself?

    cartpole-export run=RUN format=c hydra.run.dir=FOLDER
    cartpole-emulate emulator.firmware=c emulator.policy=FOLDER     # prints its port
    scripts/onboard.py /dev/pts/5 --episodes 3

Any cart with the agent on its board will do: an emulated one as here, a processor in QEMU
(scripts/qemu/cart.py --policy FOLDER), or a real one. With --fast the board outruns this computer, and its
watchdog interrupts the policy.

Homes the cart, sends START_POLICY, and then asks for the state in each period of one episode, which keeps
the cart's watchdog quiet; no motor value leaves this computer. Prints one line for each episode: the score
(6.2), the share of the time upright, and faults. A period whose state was not read counts as the next one
that was. Exit status 1 if a fault was latched.
"""

import argparse
import sys
from itertools import pairwise

import torch

from cartpole_rl.choices import choice
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.tasks.features import Measured, measured_position, measured_velocity
from cartpole_rl.tasks.rewards import SCORE, UPRIGHT_ANGLE
from cartpole_rl.wire import Fault, State
from cartpole_rl.wire.clock import seconds_between, ticks_between

PERIOD_US = 20_000


def episode(cart: SerialCart, periods: int) -> list[State]:
    """Home the cart, let its policy drive; return the states from then on, fewer if a fault ends it."""
    cart.home()
    cart.set_period(PERIOD_US)
    cart.start_policy()
    states = [cart.poll_state()]
    while ticks_between(states[0].tick, states[-1].tick) < periods and not states[-1].fault:
        states.append(cart.poll_state())
    cart.stop()
    return states


def line(states: list[State], track_half_length: float) -> str:
    """Return the result of an episode in words."""
    counts = torch.tensor([(state.cart_counts, state.pole_counts) for state in states]).T
    pairs = list(pairwise(states))
    seconds = torch.tensor([seconds_between(before.time_us, after.time_us) for before, after in pairs])
    periods = torch.tensor([ticks_between(before.tick, after.tick) for before, after in pairs])
    x, theta = measured_position(counts[:, 1:])
    x_dot, theta_dot = measured_velocity(counts[:, 1:], counts[:, :-1], seconds)
    score = (SCORE.formula(Measured(x, x_dot, theta, theta_dot), track_half_length) * periods).sum()
    upright = ((theta.abs() < UPRIGHT_ANGLE) * periods).sum() / periods.sum()
    fault = Fault(states[-1].fault)
    return (
        f"{periods.sum()} periods, {len(states)} states read, score {score:.0f}, upright "
        f"{100 * upright:.0f} % of the time, fault {fault.name if fault else 'none'}"
    )


def main() -> int:
    """Listen to episodes; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("port", help="serial port of the cart")
    parser.add_argument("--episodes", type=int, default=1, help="number of episodes (1)")
    options = parser.parse_args()
    periods, track = choice("task/swingup")["time_limit"], choice("cart/ip02")["track_half_length"]
    faults = 0
    with SerialCart(SerialSettings(port=options.port)) as cart:
        for _ in range(options.episodes):
            states = episode(cart, periods)
            print(line(states, track), flush=True)
            faults |= states[-1].fault
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
