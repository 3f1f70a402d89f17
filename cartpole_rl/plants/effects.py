"""Finds randomized parameters without any effect on a simulated cart, by simulation.

A range can have no effect for several reasons: the chosen friction does not read the parameter, a dead-band
ends below the smallest motor value, no cart is drawn from it. Each range is tested: carts are drawn twice,
with the parameter at the low and at the high end of its range and all else equal, and simulated for a few
periods under the motor values of the agent. If all motions and reports are equal, the range has no effect.
"""

import math
from collections.abc import Collection, Sequence
from functools import partial

import torch
from torch import Tensor

from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import Carts, Inputs, Period, commands_under_way, run_carts
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.rig.hardware import Encoders

TESTED = 256  # carts for each parameter
PERIODS = 6
SUBSTEPS = 4  # of a period; the step does not decide whether a parameter has an effect
SPEEDS = ((0.0, 0.0), (0.02, 0.5), (1.0, 8.0))  # m/s and rad/s, largest: at rest, slow (stiction), fast
TRACK_HALF_LENGTH = CartParameters.names().index("track_half_length")


def without_effect(
    draws: Draws,
    names: Collection[str],
    motors: Sequence[int],
    models: Models,
    period: float,
    encoders: Encoders,
) -> list[str]:
    """Return those of `names`, each with a range in `draws`, whose value within the range changes nothing.

    `motors` are the motor values of the agent, `period` is one control period in s. All calls
    draw the same random numbers.
    """
    if not names:
        return []
    device = draws.nominal.device
    ends = [draws.ends(name, TESTED, torch.Generator(device).manual_seed(0)) for name in names]
    low, high = (torch.cat(tables, 1).cpu() for tables in zip(*ends, strict=True))
    track_end = (low[TRACK_HALF_LENGTH] + high[TRACK_HALF_LENGTH]) / 2
    commands = commands_under_way(draws.longest_delay(), period)
    motion, drive, inputs = _situations(track_end, motors, commands)
    carts = [Carts(table, motion, drive) for table in (low, high)]
    same = torch.ones_like(track_end, dtype=torch.bool)
    run = partial(run_carts, models=models, period=period, substeps=SUBSTEPS, encoders=encoders)
    for now in inputs:
        after = [run(each, now) for each in carts]
        same &= _alike(*after)
        carts = [Carts(each.table, end.motion, end.drive) for each, end in zip(carts, after, strict=True)]
    changes_nothing = same.reshape(-1, TESTED).all(1).tolist()
    return [name for name, nothing in zip(names, changes_nothing, strict=True) if nothing]


def _situations(
    track_end: Tensor, motors: Sequence[int], commands: int
) -> tuple[Tensor, Tensor, list[Inputs]]:
    """Return motion [4, N] and drive [1 + D, N] to start from, and the inputs of each period.

    The carts of every parameter have the same TESTED situations. `track_end` m, [N], lies between the ends of
    a cart's two tracks: some carts rest there, since the length of the track shows nowhere else.
    """
    generator, parameters = torch.Generator().manual_seed(0), len(track_end) // TESTED
    unit = 2 * torch.rand((4, TESTED), generator=generator) - 1
    speed, turning = torch.tensor(SPEEDS)[torch.arange(TESTED) % len(SPEEDS)].unbind(1)
    pushes = torch.tensor(motors)[
        torch.randint(len(motors), (commands + PERIODS, TESTED), generator=generator)
    ]
    latency = 2 * torch.rand((PERIODS, 1, TESTED), generator=generator) - 1
    noise = torch.randn((PERIODS, 2, TESTED), generator=generator)
    rests = torch.arange(TESTED) % (2 * len(SPEEDS)) == 0  # at the track's end, upright, without a push
    x, theta = torch.where(rests, unit[0].sign(), unit[0]), torch.where(rests, 0, math.pi * unit[2])
    motion = torch.stack((x, speed * unit[1], theta, turning * unit[3])).repeat(1, parameters)
    motion[0] *= track_end
    pushes = torch.where(rests, 0, pushes).repeat(1, parameters)
    noise = torch.cat((latency, noise), 1).repeat(1, 1, parameters)
    drive = torch.cat((torch.zeros_like(motion[:1]), pushes[:commands].to(motion.dtype)))
    inputs = [Inputs(*now) for now in zip(pushes[commands:].unsqueeze(1), noise, strict=True)]
    return motion, drive, inputs


def _alike(one: Period, other: Period) -> Tensor:
    """Return which carts had equal motions and reports, [N] bool."""
    parts = ("motion", "counts", "motor_applied", "off_track")
    return torch.stack([(getattr(one, part) == getattr(other, part)).all(0) for part in parts]).all(0)
