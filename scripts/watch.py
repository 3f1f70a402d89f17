#!/usr/bin/env python
"""What does a cart report? For the first power-on of a new board: it moves nothing unless it is asked to.

    scripts/watch.py /dev/ttyUSB0             # prints its counts twice a second until Ctrl-C
    scripts/watch.py /dev/ttyUSB0 --home      # homes it first: the motor moves by itself
    scripts/watch.py /dev/ttyUSB0 --baud 115200

At its start and at its end it sends STOP. If homing fails, it prints the fault and ends with exit status 1.
It clears no fault: a restart of the board does.
"""

import argparse
import contextlib
import signal
import sys

from cartpole_rl.errors import FaultError, PlantError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.wire.messages import Fault, Flags, State

PERIODS_PER_LINE = 25
BAUD_RATES = 921600, 115200  # of the protocol; the first is the default


def line(state: State, flags: Flags) -> str:
    """Return a state in words."""
    fault = Fault(state.fault)
    return (
        f"tick {state.tick:8}  cart {state.cart_counts:8}  pole {state.pole_counts:8}  motor "
        f"{state.motor_applied:4}  {flags.name or 'idle, not homed'}  fault {fault.name if fault else 'none'}"
    )


def ending(number: int) -> BaseException:
    """Return the exception of a signal. A second Ctrl-C must not leave a homing cart without STOP."""
    return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)


def main() -> None:
    """Print what a cart reports until Ctrl-C, SIGTERM or SIGHUP."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("port", help="serial port of the cart")
    parser.add_argument("--home", action="store_true", help="home the cart first")
    parser.add_argument("--baud", type=int, choices=BAUD_RATES, default=BAUD_RATES[0], help="line speed")
    options = parser.parse_args()
    settings = SerialSettings(port=options.port, baud=options.baud)
    RaiseOnce(ending).handle(signal.SIGINT, *ending_signals())
    try:
        with SerialCart(settings) as cart, contextlib.suppress(KeyboardInterrupt):
            print(cart.information, flush=True)
            if options.home:
                print(line(cart.home(), cart.flags), flush=True)
            while True:
                states = [cart.poll_state() for _ in range(PERIODS_PER_LINE)]
                print(line(states[-1], cart.flags), flush=True)
    except FaultError as error:
        sys.exit(f"{error}; a restart of the board clears the fault, see First power-on in docs/firmware.md")
    except PlantError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
