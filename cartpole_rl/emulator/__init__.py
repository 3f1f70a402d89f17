"""The emulated cart: a program of its own that speaks the wire protocol, with its own MuJoCo physics.

It stands in for a cart on a serial port and shares no equation with the simulator.
``python -m cartpole_rl.emulator '{"clock": "real"}'`` starts one; ``docs/emulator.md`` says what
it is made of.
"""

from cartpole_rl.emulator.settings import EmulatorSettings

__all__ = ["EmulatorSettings"]
