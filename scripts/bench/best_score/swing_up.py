"""Swing-ups as alternating pushes with full force, found by evolution in separate populations."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from best_score.cart import LOST, MOST, KnownCart, wrapped
from cartpole_rl.physics.dynamics import State

PUSHES = 12  # in a swing-up
SLOWEST_SWING = 7.0  # s
ISLANDS = 8  # populations that evolve separately
PATIENCE = (1, 1, 1, 3, 3, 3, 10, 10)  # of each island: weight of `lacks` against `lost`
STANDS = 150  # points; a pole that lacks less than this stands, or nearly
GENERATIONS = 40


class Swings(NamedTuple):
    """Swing-ups that push with full force to the right, then to the left, and so on."""

    pushes: Tensor  # [N, PUSHES] steps of each push; 0 skips one
    lost: Tensor  # [N] points short of the maximum until the pole stands, or is nearest to standing
    lacks: Tensor  # [N] points for its distance from standing at that moment
    arrival: Tensor  # [N] steps until that moment

    def at(self, rows: Tensor) -> "Swings":
        """Return the swing-ups `rows`."""
        return Swings(*(value[rows] for value in self))


def pushed(cart: KnownCart, pushes: Tensor, steps: int) -> Tensor:
    """Return actions [N, steps] for pushes [N, PUSHES]: in each step the one nearest to the mean force."""
    force = torch.where(torch.arange(PUSHES) % 2 == 0, cart.forces.max(), cart.forces.min())
    starts = (pushes.cumsum(1) - pushes).unsqueeze(1)  # [N, 1, PUSHES]
    moments = torch.arange(steps + 1.0).reshape(1, -1, 1)
    spent = (moments - starts).clamp(min=0).minimum(pushes.unsqueeze(1))
    impulse = (spent * force).sum(2)  # [N, steps + 1] N steps
    return (impulse.diff(dim=1).unsqueeze(2) - cart.forces).abs().argmin(2)


def lacking(cart: KnownCart, state: State) -> Tensor:
    """Return points [N] for the distance of states from standing in the middle.

    The weights are large, so that saving time pays only if the pole stands in the end.
    """
    theta = wrapped(state.theta)
    falls = theta + state.theta_dot / cart.growth  # the part of the state that grows without control
    stops_at = (state.x + 0.3 * state.x_dot) / cart.reach
    speeds = 60 * state.theta_dot.abs() + 120 * state.x_dot.abs()
    return 360 * (theta.abs() + falls.abs() + stops_at**2) + speeds


def swung(cart: KnownCart, position: float, pushes: Tensor, steps: int, patience: Tensor) -> Swings:
    """Run swing-ups from hanging at `position` m for `steps`; `patience` [N] weighs lacks against lost."""
    count = len(pushes)
    actions = pushed(cart, pushes, steps)
    nodes = cart.hanging(position).at(torch.zeros(count, dtype=torch.int64))
    lost, lacks, arrival = torch.full((count,), LOST), torch.full((count,), LOST), torch.zeros(count)
    alive = torch.ones(count, dtype=torch.bool)
    for step in range(steps):
        nodes, _, on_track = cart.step(nodes, actions[:, step])
        alive &= on_track
        lost_now, lacks_now = MOST * (step + 1) - nodes.points, lacking(cart, nodes.state)
        better = alive & (lost_now + patience * lacks_now < lost + patience * lacks)
        lost, lacks = torch.where(better, lost_now, lost), torch.where(better, lacks_now, lacks)
        arrival = arrival.masked_fill(better, step + 1)
    return Swings(pushes, lost, lacks, arrival)


def evolved(
    cart: KnownCart, position: float, rollouts: int, generations: int, generator: torch.Generator
) -> Swings:
    """Return the best swing-up of each island; a generation has `rollouts` swing-ups on all islands."""
    each = max(rollouts // ISLANDS, 8)
    firsts = torch.arange(0, ISLANDS * each, each).unsqueeze(1)  # [ISLANDS, 1] first row of each island
    patience = torch.tensor(PATIENCE, dtype=torch.float32).repeat_interleave(each)
    pushes = first_generation(cart, ISLANDS * each, generator)
    steps = min(cart.periods(SLOWEST_SWING), cart.steps)
    for _ in range(generations):
        swings = swung(cart, position, pushes, steps, patience)
        loss = swings.lost + patience * swings.lacks
        rows = firsts + loss.view(ISLANDS, each).argsort(1)
        best = swings.at(rows[:, 0])
        arrivals = best.arrival[best.lacks < STANDS]
        if len(arrivals):  # much slower swing-ups need not be simulated to their end
            steps = min(steps, int(1.2 * arrivals.min()) + 10)
        elite = pushes[rows[:, : each // 8]]
        pushes = torch.cat((elite, offspring(elite, each - each // 8, generator)), 1).flatten(0, 1)
    falls_short = torch.where(best.lacks < STANDS, 0, LOST)
    return best.at((best.lost + best.lacks + falls_short).argsort())


def first_generation(cart: KnownCart, count: int, generator: torch.Generator) -> Tensor:
    """Return random pushes [count, PUSHES] of up to the time the pole takes from one side to the other."""
    swing = math.pi / cart.growth / cart.config.control_period  # steps
    pushes = 1.5 * swing * torch.rand((count, PUSHES), generator=generator)
    pushes[::2, 0] = 0  # half of them begin to the left
    return pushes


def offspring(elite: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` children of `elite` [ISLANDS, parents, PUSHES] in each island."""
    islands, parents = elite.shape[:2]

    def chance(numbers: int) -> Tensor:
        return torch.rand((islands, count, numbers), generator=generator)

    def parent() -> Tensor:
        which = torch.randint(parents, (islands, count), generator=generator)
        return elite[torch.arange(islands).unsqueeze(1), which]

    mixed = (chance(1) < 0.3) & (chance(PUSHES) < 0.5)
    child = torch.where(mixed, parent(), parent())
    spread = 0.1 * 80 ** chance(1)  # 0.1 to 8 steps
    noise = torch.randn((islands, count, PUSHES), generator=generator)
    return (child + spread * noise * (chance(PUSHES) < 0.4)).clamp(min=0)
