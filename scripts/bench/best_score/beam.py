"""Landing and holding: beam search that keeps the best state of each small cell of the state space."""

from collections.abc import Sequence

import torch
from torch import Tensor

from best_score.cart import LOST, KnownCart, Nodes, wrapped
from cartpole_rl.physics.dynamics import State

LANDINGS = (0.06, 0.2)  # s before the pole stands at which a landing begins
SETTLING = 0.6  # s after that moment at which a landing ends
HOLDING_STATES, KEPT = 1000, 0.4  # holding keeps 0.4 s of what it finds
LOOKAHEADS = (0.8, 1.6)  # s; the better of two holdings counts, as slow carts need a longer look
POINTS_PERIOD = 0.02  # s, for which the points in `risk` are
CELL = (0.002, 0.01, 0.006, 0.03)  # m, m/s, rad, rad/s


def landed(cart: KnownCart, position: float, swing: list[int], arrival: int, states: int) -> list[list[int]]:
    """Return sequences until SETTLING after `arrival`, one for each beginning of the landing."""
    sequences = []
    for early in LANDINGS:
        first = swing[: max(arrival - cart.periods(early), 0)]
        steps = min(arrival + cart.periods(SETTLING), cart.steps) - len(first)
        root = cart.run(cart.hanging(position), first)
        sequences.append(first + beam(cart, root, steps, states))
    return sequences


def held(cart: KnownCart, position: float, actions: list[int]) -> list[int]:
    """Return the sequence continued to the end of the episode; the better one of LOOKAHEADS."""

    def points(found: list[int]) -> tuple[int, float]:
        return len(found), float(cart.run(cart.hanging(position), found).points)

    return max((continued(cart, position, actions, ahead) for ahead in LOOKAHEADS), key=points)


def continued(cart: KnownCart, position: float, actions: list[int], lookahead: float) -> list[int]:
    """Return the sequence continued to the end of the episode.

    Each search starts from the state that the cart reaches alone: among many states it differs by rounding.
    """
    actions, nodes = list(actions), cart.run(cart.hanging(position), actions)
    while len(actions) < cart.steps:
        left = cart.steps - len(actions)
        ahead = beam(cart, nodes, min(cart.periods(lookahead), left), HOLDING_STATES)
        kept = ahead if len(ahead) in (0, left) else ahead[: cart.periods(KEPT)]
        if not kept:
            break
        actions, nodes = actions + kept, cart.run(nodes, kept)
    return actions


def beam(cart: KnownCart, root: Nodes, steps: int, states: int) -> list[int]:
    """Return the best `steps` actions found from `root`, one node; fewer if every cart leaves the track."""
    nodes, history = root, []
    for _ in range(steps):
        count, actions = len(nodes.points), len(cart.motors)
        parents = torch.arange(count).repeat_interleave(actions)
        chosen = torch.arange(actions).repeat(count)
        after, _, on_track = cart.step(nodes.at(parents), chosen)
        rank = torch.where(on_track, after.points - risk(cart, after.state), -LOST)
        rows = best_of_cells(cells(after.state), rank, states)
        if len(rows) == 0:
            break
        nodes = after.at(rows)
        history.append((parents[rows], chosen[rows]))
    return traced(history, int((nodes.points - risk(cart, nodes.state)).argmax()))


def risk(cart: KnownCart, state: State) -> Tensor:
    """Return the points [N] that states near upright are going to lose, roughly."""
    falls = wrapped(state.theta) + state.theta_dot / cart.growth
    stops_at = ((state.x + cart.coasting * state.x_dot) / cart.reach).abs()
    points = 100 * falls.abs() + 30 * stops_at**2 + 200 * (stops_at - 0.8).clamp(min=0) ** 2
    return points * (POINTS_PERIOD / cart.config.control_period)


def cells(state: State) -> Tensor:
    """Return a number [N] for each state's cell; a clash of two cells is very rare."""
    number = torch.zeros_like(state.x, dtype=torch.int64)
    for value, width in zip(state._replace(theta=wrapped(state.theta)), CELL, strict=True):
        number = number * 1_000_003 + (value / width).floor().long()
    return number


def best_of_cells(cell: Tensor, rank: Tensor, count: int) -> Tensor:
    """Return the rows of the best state of each cell, at most `count`, none of them off the track."""
    cell = cell.unique(return_inverse=True)[1]  # numbers from 0 on
    best = torch.full_like(rank, -LOST).scatter_reduce_(0, cell, rank, "amax")
    rows = ((rank == best[cell]) & (rank > -LOST / 2)).nonzero().squeeze(1)
    return rows[rank[rows].topk(min(count, len(rows))).indices]


def traced(history: Sequence[tuple[Tensor, Tensor]], row: int) -> list[int]:
    """Return the actions that led to `row` of the last step, from each step's (parent row, action) [N]."""
    actions = []
    for parents, chosen in reversed(history):
        actions.append(int(chosen[row]))
        row = int(parents[row])
    return actions[::-1]
