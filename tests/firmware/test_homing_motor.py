"""The motor values of homing, by the C firmware for a rig that no file describes: flags override a number."""

import pytest
from firmwares import needs_compiler

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.rig.hardware import LARGEST_MOTOR, nominal_hardware
from cartpole_rl.wire.frames import encode_frame
from cartpole_rl.wire.messages import Fault, Hello, Home, Message

PERIOD = 20_000
LONGEST = 5_000_000  # us, of a homing that finds both ends at once


@needs_compiler
@pytest.mark.parametrize("force", [3.0, 6.0, 1e6])
def test_homing_pushes_a_held_cart_no_harder_than_the_largest_motor_value(force: float) -> None:
    """That counts as a full push: the cart is held, at both ends."""
    hardware = nominal_hardware().model_copy(update={"gentle_force": force})  # which is not validated
    cart, motors, now = CFirmware(lambda: 0, hardware=hardware), [], 0

    def send(message: Message) -> None:
        cart.receive(encode_frame(message, 1)[:-1], now)

    send(Home())
    while cart.homing and now < LONGEST:
        now += PERIOD
        send(Hello())
        cart.tick(now, 0, 0)
        cart.drive(now)
        motors.append(cart.motor)
    assert -LARGEST_MOTOR <= min(motors) < 0 < max(motors) <= LARGEST_MOTOR
    assert cart.fault == Fault.HOMING
