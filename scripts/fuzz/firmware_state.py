"""The whole state of the Python firmware as numbers, in the order of ``cart_snapshot`` of the C firmware."""

import struct
from typing import Any

from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.emulator.guards import SAMPLES

STAGES = {"find_hanging": 4, "brake_swing": 5, "wait_until_still": 7}  # of homing; see stage_of


def state_of(firmware: Firmware) -> list[int]:
    """Return the state of a firmware."""
    return [*core(firmware), *limits(firmware), *guards(firmware), *homing(firmware)]


def core(firmware: Any) -> list[int]:
    """Return flags, counters, times and zeros."""
    zeros, line = firmware._zeros, firmware._line
    return [
        firmware.period_us,
        firmware.armed,
        firmware.homed,
        firmware.homing,
        int(firmware.fault),
        int(firmware._reported),
        firmware._last_sequence,
        firmware._sequence,
        firmware._ticks,
        *firmware._measured_us,
        firmware._command_us is not None,
        firmware._command_us or 0,
        firmware._expires_us,
        firmware._heard_us,
        zeros.left_stop,
        zeros.right_stop,
        zeros.hanging,
        firmware._pole_zero,
        line.requested,
        len(line._pending),
        firmware._seen,
        firmware._pressed,
        firmware._pressed_at,
        firmware._waited_us if firmware.homing else 0,
    ]


def limits(firmware: Any) -> list[int]:
    """Return the limits of the track and the samples of the position, the newest first."""
    limits = firmware._limits
    samples = [*zip(*map(reversed, (limits._us, limits._carts, limits._poles)), strict=True)]
    unused = [(0, 0, 0)] * (SAMPLES - len(samples))
    return [
        firmware._limited,
        firmware._cart,
        firmware._pole,
        limits.blocked,
        limits.brake,
        limits._until_us,
        limits._moved_us,
        limits._blind_us,
        limits._looked_us,
        limits._count is not None,
        limits._count or 0,
        limits._speed_um,
        limits._way_nm,
        len(samples),
        limits._fresh,
        *(number for sample in samples + unused for number in sample),
    ]


def guards(firmware: Any) -> list[int]:
    """Return the state of each guard."""
    stalls, carts, poles = firmware._stalls, firmware._cart_freezes, firmware._pole_freezes
    anchor, right = stalls._anchor or (0, False)
    pushed = stalls._anchor is not None
    return [
        (1 if right else -1) if pushed else 0,
        anchor,
        stalls._since_us if pushed else 0,
        *jump(firmware._cart_jumps),
        *jump(firmware._pole_jumps),
        carts._count is not None,
        carts._count or 0,
        carts._direction,
        carts._lasts_us,
        carts._pushed_us[1],
        carts._pushed_us[-1],
        poles._pole is not None,
        poles._pole or 0,
        poles._cart,
        poles._elapsed_us,
        poles._moved,
        poles._lowest,
        poles._highest,
        poles._rise,
        poles._fall,
    ]


def jump(watch: Any) -> list[int]:
    """Return the state of a JumpWatch."""
    return [watch._last is not None, watch._last or 0]


def homing(firmware: Any) -> list[int]:
    """Return stage, time, servo and window of a homing that has handled a reading; else zeros."""
    stack = generators(firmware._homing)
    if len(stack) < 2:
        return [0, 0, 0, 0, 0, -1, 0, 0]
    stage, local = stage_of(stack), stack[-1].gi_frame.f_locals
    servo = local.get("servo")
    window = local["watch"].window if "watch" in local else local.get("window")
    return [
        stage,
        local["elapsed"],
        bits(servo._reference) if servo else 0,
        bits(servo._integral) if servo else 0,
        len(window._counts) if window else 0,
        int(window.spread) if window and window.full else -1,
        local["hanging"] if stage in (4, 5) else 0,
        local["widest"] if stage == 5 else 0,
    ]


def generators(outermost: Any) -> list[Any]:
    """Return a generator, if it is one, and those that it waits for."""
    stack = []
    while outermost is not None:
        stack.append(outermost)
        outermost = outermost.gi_yieldfrom
    return stack


def stage_of(stack: list[Any]) -> int:
    """Return the number of the stage of homing, as in ``firmware/src/cart_homing.h``."""
    name, local = stack[-1].gi_code.co_name, stack[-1].gi_frame.f_locals
    if name == "touch_stop":
        leaves = stack[-2].gi_code.co_name == "leave_switch"
        return 0 if leaves else 1 if local["direction"] < 0 else 2
    if name == "centre":
        return 3
    return STAGES[name]


def bits(number: float) -> int:
    """Return the 64 bits of a number as a signed integer."""
    return struct.unpack("<q", struct.pack("<d", number))[0]
