"""The emulated cart: a separate program that speaks the wire protocol, with its own MuJoCo physics.

It replaces a cart on a serial port and shares no equation with the simulator. Start one with
``python -m cartpole_rl.emulator '{"clock": "real"}'``. ``docs/emulator.md`` describes it.
"""
