"""Which randomized parameters change nothing that a simulated cart does, found by trying.

A range can be without effect for many reasons: the chosen friction does not read the parameter, a dead-band
ends below the smallest motor value, no cart is drawn from it. So each range is tried: carts are drawn twice,
with the parameter at the low and at the high end of its range and all else equal, and simulated for a few
periods under the motor values of the agent. If they move alike and report alike, the range has no effect.
"""

import math
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulation import Carts, Given, Period, run_carts
from cartpole_rl.randomization.found import Draws

TRIED = 256  # carts for each parameter
PERIODS = 6
SUBSTEPS = 4  # of the integration in a period; how fine it is decides no parameter's effect
SPEEDS = ((0.0, 0.0), (0.02, 0.5), (1.0, 8.0))  # m/s and rad/s, largest: at rest, slow (stiction), fast
TRACK_HALF_LENGTH = CartParameters.names().index("track_half_length")


def without_effect(
    draws: Draws, names: Collection[str], motors: Sequence[int], models: Models, period: float
) -> list[str]:
    """Those of `names`, each with a range in `draws`, whose value within the range changes nothing.

    `motors` are the motor values of the agent, `period` is one control period in s. All is drawn by a
    generator of its own, alike in each call.
    """
    if not names:
        return []
    ends = [draws.ends(name, TRIED, torch.Generator().manual_seed(0)) for name in names]
    low, high = (torch.cat(tables, 1) for tables in zip(*ends, strict=True))
    track_end = (low[TRACK_HALF_LENGTH] + high[TRACK_HALF_LENGTH]) / 2
    commands = 1 + max(1, math.ceil(draws.longest_delay() / period - 1e-9))  # that can be under way
    motion, drive, given = _situations(track_end, motors, commands)
    carts = [Carts(table, motion, drive) for table in (low, high)]
    same = torch.ones_like(track_end, dtype=torch.bool)
    for now in given:
        after = [run_carts(each, now, models=models, period=period, substeps=SUBSTEPS) for each in carts]
        same &= _alike(*after)
        carts = [Carts(each.table, end.motion, end.drive) for each, end in zip(carts, after, strict=True)]
    changes_nothing = same.reshape(-1, TRIED).all(1).tolist()
    return [name for name, nothing in zip(names, changes_nothing, strict=True) if nothing]


def _situations(
    track_end: Tensor, motors: Sequence[int], commands: int
) -> tuple[Tensor, Tensor, list[Given]]:
    """Motion [4, N] and drive [1 + D, N] to start from, and what comes in with each period.

    The same TRIED situations are met by the carts of every parameter. `track_end` m, [N], lies between the
    ends of a cart's two tracks: how long the track is shows nowhere else, so that some carts rest there.
    """
    generator, parameters = torch.Generator().manual_seed(0), len(track_end) // TRIED
    unit = 2 * torch.rand((4, TRIED), generator=generator) - 1
    speed, turning = torch.tensor(SPEEDS)[torch.arange(TRIED) % len(SPEEDS)].unbind(1)
    pushes = torch.tensor(motors)[
        torch.randint(len(motors), (commands + PERIODS, TRIED), generator=generator)
    ]
    latency = 2 * torch.rand((PERIODS, 1, TRIED), generator=generator) - 1
    noise = torch.randn((PERIODS, 2, TRIED), generator=generator)
    rests = torch.arange(TRIED) % (2 * len(SPEEDS)) == 0  # at the track's end, upright, without a push
    x, theta = torch.where(rests, unit[0].sign(), unit[0]), torch.where(rests, 0, math.pi * unit[2])
    motion = torch.stack((x, speed * unit[1], theta, turning * unit[3])).repeat(1, parameters)
    motion[0] *= track_end
    pushes = torch.where(rests, 0, pushes).repeat(1, parameters)
    chance = torch.cat((latency, noise), 1).repeat(1, 1, parameters)
    drive = torch.cat((torch.zeros_like(motion[:1]), pushes[:commands].to(motion.dtype)))
    given = [Given(*now) for now in zip(pushes[commands:].unsqueeze(1), chance, strict=True)]
    return motion, drive, given


def _alike(one: Period, other: Period) -> Tensor:
    """Which carts moved alike and told the host alike, [N] bool."""
    parts = ("motion", "counts", "motor_applied", "off_track")
    return torch.stack([(getattr(one, part) == getattr(other, part)).all(0) for part in parts]).all(0)
