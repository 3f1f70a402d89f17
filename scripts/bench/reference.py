#!/usr/bin/env python
"""The best 500-step score (6.2) that a search with full knowledge of the simulated cart finds from hanging.

    scripts/bench/reference.py pole=large                          # overrides as for cartpole-train
    scripts/bench/reference.py --length 0.4 --states 1000          # a rod of the length experiment
    scripts/bench/reference.py --all --json scripts/bench/references.json

Offline and without learning. Nothing here could run on a cart: the search knows the true state, the
equations, and what each encoder will count. What it finds is a score that was reached, so the best possible
one is that or more. Each score is that of a replay through the environment.

How it searches, for each start:

1. Swing-up (`evolved`). The quickest ones push with all force to one side, then to the other, and so on:
   twelve durations say all, and fractions of a step are taken by the force levels in between. Populations of
   durations evolve apart from each other, judged by the points lost until the pole stands and by what it then
   lacks of standing; how much the latter weighs differs between them.
2. Landing (`beam`). The last moments are searched anew, over all actions: of each small cell of the state
   space the best state is kept, of all cells the best `states`. The best populations' winners land; the best
   of them goes on.
3. Holding (`held`). The same with few states, 40 steps ahead, of which 20 are made.

All of it is done with 1000 states (rollouts in a generation, states in a landing), then with three times as
many, up to `states`. The best of all is kept, so that more states never find less.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import open_dict
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor

from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.commands.composition import as_mapping
from cartpole_rl.envs.build import randomizer, simulated_env
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.physics.actuator import static_force
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.tasks.features import (
    CART_METRES_PER_COUNT,
    POLE_RADIANS_PER_COUNT,
    Measured,
    measured_position,
    measured_velocity,
)
from cartpole_rl.tasks.rewards import BONUS, UPRIGHT_ANGLE, UPRIGHT_SPEED, score
from cartpole_rl.tasks.settings import Start, StartSettings
from cartpole_rl.tasks.upright import upright_since
from cartpole_rl.workflows.config import TrainConfig

STARTS = (-0.1, -0.05, 0.0, 0.05, 0.1)  # m: an evaluation draws the cart within 0.1 m of the middle
POLES = ("medium", "large")
LENGTHS = tuple(tenths / 10 for tenths in range(2, 11))  # m, of the length experiment
FIRST_RUNG, RUNG = 1000, 3  # states of the first search, and how many times as many the next one keeps
SIDED = ("track_tilt", "cart_coulomb_asymmetry", "force_asymmetry", "angle_offset")  # 0: left is as right

PUSHES = 12  # of a swing-up
SLOWEST_SWING = 350  # steps
ISLANDS = 8  # populations that evolve apart
PATIENCE = (1, 1, 1, 3, 3, 3, 10, 10)  # of each: how much standing is worth to it, compared with time
STANDS = 150  # points; what lacks less than this stands, or nearly
GENERATIONS = 40
LANDINGS = (3, 10)  # steps before the pole stands from which the beam takes over
LANDED = 4  # of the populations' winners
SETTLING = 30  # steps that a landing looks on after that
HOLDING_STATES, LOOKAHEAD, MADE = 300, 40, 20
CELL = (0.002, 0.01, 0.006, 0.03)  # m, m/s, rad, rad/s
HASHED = 1 << 22  # cells are told apart by their number modulo this
MOST = 1 + 2 * BONUS  # points of a step, standing still in the middle
LOST = 1e9  # off the track; more than any score


class Nodes(NamedTuple):
    """N states of a search, with all that the next step and its score depend on."""

    state: State  # true, [N] each
    force: Tensor  # [N] N, behind the actuator's lag
    motors: Tensor  # [D, N] motor values under way, newest first
    counts: Tensor  # [2, N] encoder counts
    points: Tensor  # [N] score so far

    def at(self, rows: Tensor) -> "Nodes":
        """The nodes `rows`, which may repeat."""
        state = State(*(value[rows] for value in self.state))
        return Nodes(state, self.force[rows], self.motors[:, rows], self.counts[:, rows], self.points[rows])


class KnownCart:
    """The nominal cart of a config, as the search steps it: many states at once."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.randomizer = randomizer(config)
        self.models = config.models(config.plant)
        self.motors = torch.tensor(config.actions.motors, dtype=torch.float32)
        self.forces = static_force(self.motors, self.carts(len(self.motors)), self.models.actuator)
        self.commands = 1 + max(1, math.ceil(self.randomizer.longest_delay() / config.control_period - 1e-9))
        self.one = self.carts(1)
        self.reach = float(self.one.track_half_length)
        stiffness = self.one.first_moment * GRAVITY / self.one.pivot_inertia
        self.growth = float(stiffness.sqrt())  # 1/s, of the angle of a falling pole
        self._carts = self.one

    @property
    def steps(self) -> int:
        """Control periods in an episode."""
        return self.config.task.time_limit

    @property
    def symmetric(self) -> bool:
        """Whether left and right are alike, so that a mirrored start has the same best score."""
        motors = self.config.actions.motors
        alike = sorted(motors) == sorted(-motor for motor in motors)
        same_dead_band = bool(self.one.deadband_left == self.one.deadband_right)
        return alike and same_dead_band and all(float(getattr(self.one, name)) == 0 for name in SIDED)

    def carts(self, count: int) -> CartParameters:
        """`count` nominal carts."""
        return CartParameters.from_table(self.randomizer.nominal.unsqueeze(1).repeat(1, count))

    def hanging(self, position: float) -> Nodes:
        """One node: at rest at `position` m, the pole hanging."""
        state = hanging(position)
        none = torch.zeros(1)
        return Nodes(state, none, torch.zeros(self.commands, 1), self.encoders(state, self.one), none)

    def step(self, nodes: Nodes, action: Tensor) -> tuple[Nodes, Tensor, Tensor]:
        """(nodes after a period, points of the step, whether they are on the track), from actions [N]."""
        period, count = self.config.control_period, len(action)
        if len(self._carts) != count:
            self._carts = self.carts(count)
        cart = self._carts
        motors = torch.cat((self.motors[action].unsqueeze(0), nodes.motors[:-1]))
        drive = Drive(nodes.force, motors.unbind(0))
        substeps = self.config.plant.substeps
        state, drive = run_period(nodes.state, drive, cart.latency, cart, self.models, period, substeps)
        counts = self.encoders(state, cart)
        x, theta = measured_position(counts)
        x_dot, theta_dot = measured_velocity(counts, nodes.counts, torch.full((count,), period))
        points = score(Measured(x, x_dot, theta, theta_dot), self.config.task.x_max)
        on_track = state.x.abs() <= cart.track_half_length
        return Nodes(state, drive.force, motors, counts, nodes.points + points), points, on_track

    def run(self, nodes: Nodes, actions: Sequence[int]) -> Nodes:
        """One node after a sequence; nothing counts after it left the track."""
        for action in actions:
            nodes, _, on_track = self.step(nodes, torch.tensor([action]))
            if not on_track:
                break
        return nodes

    @staticmethod
    def encoders(state: State, cart: CartParameters) -> Tensor:
        """Counts [2, N] of carts whose encoders have no noise."""
        turned = state.theta + cart.angle_offset
        return torch.stack((state.x / CART_METRES_PER_COUNT, turned / POLE_RADIANS_PER_COUNT)).round().long()


def hanging(position: float) -> State:
    """The true state of one cart at rest at `position` m with a hanging pole."""
    return State(torch.tensor([position]), torch.zeros(1), torch.full((1,), math.pi), torch.zeros(1))


def wrapped(theta: Tensor) -> Tensor:
    """Angles in [-pi, pi)."""
    return torch.remainder(theta + math.pi, 2 * math.pi) - math.pi


# swing-up: pushes


class Swings(NamedTuple):
    """Swing-ups with all force to the right, then to the left, and so on."""

    pushes: Tensor  # [N, PUSHES] duration of each push in steps; 0 leaves one out
    lost: Tensor  # [N] points short of 11 a step until the pole stands, or comes nearest to that
    lacks: Tensor  # [N] points for what it then lacks of standing
    arrival: Tensor  # [N] steps until then

    def at(self, rows: Tensor) -> "Swings":
        """The swing-ups `rows`."""
        return Swings(*(value[rows] for value in self))


def pushed(cart: KnownCart, pushes: Tensor, steps: int) -> Tensor:
    """Actions [N, steps] of pushes [N, PUSHES]: in each step the one nearest to the mean force."""
    force = torch.where(torch.arange(PUSHES) % 2 == 0, cart.forces.max(), cart.forces.min())
    begins = (pushes.cumsum(1) - pushes).unsqueeze(1)  # [N, 1, PUSHES]
    moments = torch.arange(steps + 1.0).reshape(1, -1, 1)
    spent = (moments - begins).clamp(min=0).minimum(pushes.unsqueeze(1))
    impulse = (spent * force).sum(2)  # [N, steps + 1] N steps
    return (impulse.diff(dim=1).unsqueeze(2) - cart.forces).abs().argmin(2)


def lacking(cart: KnownCart, state: State) -> Tensor:
    """Points for what states lack of standing in the middle, [N]: many, so only standing is worth time."""
    theta = wrapped(state.theta)
    falls = theta + state.theta_dot / cart.growth  # what grows if nothing is done
    stops_at = (state.x + 0.3 * state.x_dot) / cart.reach
    speeds = 60 * state.theta_dot.abs() + 120 * state.x_dot.abs()
    return 360 * (theta.abs() + falls.abs() + stops_at**2) + speeds


def swung(cart: KnownCart, position: float, pushes: Tensor, steps: int, patience: Tensor) -> Swings:
    """Run swing-ups from hanging at `position` for `steps`; `patience` [N] decides what comes nearest."""
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
    """The best swing-up of each of ISLANDS populations, which have `rollouts` in a generation together."""
    each = max(rollouts // ISLANDS, 8)
    firsts = torch.arange(0, ISLANDS * each, each).unsqueeze(1)  # [ISLANDS, 1] first row of each island
    patience = torch.tensor(PATIENCE, dtype=torch.float32).repeat_interleave(each)
    pushes = beginners(cart, ISLANDS * each, generator)
    steps = min(SLOWEST_SWING, cart.steps)
    for _ in range(generations):
        swings = swung(cart, position, pushes, steps, patience)
        worth = swings.lost + patience * swings.lacks
        rows = firsts + worth.view(ISLANDS, each).argsort(1)
        best = swings.at(rows[:, 0])
        arrivals = best.arrival[best.lacks < STANDS]
        if len(arrivals):  # those that take much longer need not be followed
            steps = min(steps, int(1.2 * arrivals.min()) + 10)
        elite = pushes[rows[:, : each // 8]]
        pushes = torch.cat((elite, offspring(elite, each - each // 8, generator)), 1).flatten(0, 1)
    falls_short = torch.where(best.lacks < STANDS, 0, LOST)
    return best.at((best.lost + best.lacks + falls_short).argsort())


def beginners(cart: KnownCart, count: int, generator: torch.Generator) -> Tensor:
    """Random pushes [count, PUSHES] that last up to as long as the pole takes from one side to the other."""
    swing = math.pi / cart.growth / cart.config.control_period  # steps
    pushes = 1.5 * swing * torch.rand((count, PUSHES), generator=generator)
    pushes[::2, 0] = 0  # half of them begin leftward
    return pushes


def offspring(elite: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`count` children in each island, [ISLANDS, count, PUSHES], of `elite` [ISLANDS, parents, PUSHES]."""
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


# landing and holding: beam search


def beam(cart: KnownCart, root: Nodes, steps: int, states: int) -> list[int]:
    """Actions that lead from `root`, one node, to many points in `steps`; fewer where every cart is lost."""
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
    """Points that states near upright will cost yet, roughly, [N]."""
    falls = wrapped(state.theta) + state.theta_dot / cart.growth
    return 100 * falls.abs() + 30 * ((state.x + 0.3 * state.x_dot) / cart.reach) ** 2


def cells(state: State) -> Tensor:
    """A number [N] for each state, the same for states in the same cell."""
    number = torch.zeros_like(state.x, dtype=torch.int64)
    for value, width in zip(state._replace(theta=wrapped(state.theta)), CELL, strict=True):
        number = number * 1009 + (value / width).floor().long()
    return torch.remainder(number, HASHED)


def best_of_cells(cell: Tensor, rank: Tensor, count: int) -> Tensor:
    """Rows of the best state of each cell, at most `count` of them and none that is lost."""
    best = torch.full((HASHED,), -LOST).scatter_reduce_(0, cell, rank, "amax")
    rows = ((rank == best[cell]) & (rank > -LOST / 2)).nonzero().squeeze(1)
    return rows[rank[rows].topk(min(count, len(rows))).indices]


def traced(history: Sequence[tuple[Tensor, Tensor]], row: int) -> list[int]:
    """The actions that led to `row` of the last step, from (row before, action) [N] of each step."""
    actions = []
    for parents, chosen in reversed(history):
        actions.append(int(chosen[row]))
        row = int(parents[row])
    return actions[::-1]


def landed(cart: KnownCart, position: float, swing: list[int], arrival: int, states: int) -> list[list[int]]:
    """Sequences until SETTLING steps after `arrival`, each with a beam's landing from another moment on."""
    sequences = []
    for early in LANDINGS:
        begin = swing[: max(arrival - early, 0)]
        steps = min(arrival + SETTLING, cart.steps) - len(begin)
        root = cart.run(cart.hanging(position), begin)
        sequences.append(begin + beam(cart, root, steps, states))
    return sequences


def held(cart: KnownCart, position: float, actions: list[int]) -> list[int]:
    """The sequence, gone on to the end of the episode.

    Each look ahead begins where the cart itself is: alone it is a rounding error off what it is among many.
    """
    actions, nodes = list(actions), cart.run(cart.hanging(position), actions)
    while len(actions) < cart.steps:
        left = cart.steps - len(actions)
        ahead = beam(cart, nodes, min(LOOKAHEAD, left), HOLDING_STATES)
        made = ahead if len(ahead) in (0, left) else ahead[:MADE]
        if not made:
            break
        actions, nodes = actions + made, cart.run(nodes, made)
    return actions


# the whole search


def rungs(states: int) -> Iterator[int]:
    """1000, 3000, 9000 and so on, up to and with `states`."""
    rung = FIRST_RUNG
    while rung < states:
        yield rung
        rung *= RUNG
    yield states


def search(cart: KnownCart, position: float, states: int, generations: int = GENERATIONS) -> list[int]:
    """The actions of the best episode found from hanging at `position` m."""
    found: list[list[int]] = []
    for rung in rungs(states):
        generator = torch.Generator().manual_seed(rung)
        swings = evolved(cart, position, rung, generations, generator)
        sequences: list[list[int]] = []
        swings = swings.at(torch.arange(LANDED))
        for swing, arrival in zip(pushed(cart, swings.pushes, cart.steps), swings.arrival, strict=True):
            sequences += landed(cart, position, swing.tolist(), int(arrival), rung)
        found.append(held(cart, position, min(sequences, key=partial_loss(cart, position))))
    return max(found, key=lambda actions: float(cart.run(cart.hanging(position), actions).points))


def partial_loss(cart: KnownCart, position: float) -> Callable[[list[int]], float]:
    """What ranks sequences of different lengths: points short of 11 a step, and what their end will cost."""

    def loss(actions: list[int]) -> float:
        nodes = cart.run(cart.hanging(position), actions)
        upright = wrapped(nodes.state.theta).abs() < UPRIGHT_ANGLE
        end = torch.where(upright, risk(cart, nodes.state), lacking(cart, nodes.state))
        return float(MOST * len(actions) - nodes.points + end)

    return loss


class Replay(NamedTuple):
    """An episode in the environment."""

    points: list[float]  # score (6.2) of each step
    theta: list[float]  # rad, measured: at the start and after each step
    theta_dot: list[float]  # rad/s

    def figures(self, period: float) -> dict[str, float | None]:
        """What stands in the JSON file for a start."""
        angle = np.abs(np.array(self.theta[1:]))
        upright = angle < UPRIGHT_ANGLE
        still = upright & (np.abs(np.array(self.theta_dot[1:])) < UPRIGHT_SPEED)
        moments = period * np.arange(len(self.theta), dtype=np.float64)
        return {
            "score": round(sum(self.points), 1),
            "time_to_upright_s": upright_since(moments, np.array(self.theta)),
            "upright_fraction": float(upright.mean()),
            "still_fraction_of_upright": float(still.sum() / max(upright.sum(), 1)),
        }


def replay(config: TrainConfig, position: float, actions: Sequence[int]) -> Replay:
    """Run a sequence through the environment, from hanging at `position` m, until it ends."""
    still = StartSettings(
        angle=Start.HANGING, position_spread=0, angle_spread=0, speed_spread=0, angular_speed_spread=0
    )
    env = simulated_env(config, config.plant, 1, still, 0)
    assert isinstance(env.plant, SimulatedPlant)
    step = env.reset()
    env.plant.place(hanging(position))  # after this the score depends on no earlier frame
    states, points = [step["state"][0]], []
    for action in actions:
        step = env.step(step.set("action", torch.tensor([action])))["next"]
        states.append(step["state"][0])
        points.append(float(step["score"]))
        if step["done"].any():
            break
    return Replay(points, [float(state[2]) for state in states], [float(state[3]) for state in states])


def reference(config: TrainConfig, states: int, generations: int = GENERATIONS) -> dict[str, Any]:
    """Best scores found from each of STARTS, their mean, and what the search took.

    A cart that is alike to both sides is searched on one side: mirrored episodes have the same score.
    """
    cart, began = KnownCart(config), time.process_time()
    by_start: dict[float, dict[str, float | None]] = {}
    for position in STARTS[::-1]:
        if cart.symmetric and position < 0:
            by_start[position] = by_start[-position]
        else:
            actions = search(cart, position, states, generations)
            by_start[position] = replay(config, position, actions).figures(config.control_period)
    return {
        "score": round(float(np.mean([figures["score"] for figures in by_start.values()])), 1),
        "states": states,
        "seconds": round(time.process_time() - began, 1),
        "starts": {f"{position:g} m": by_start[position] for position in STARTS},
    }


# the command


def composed(overrides: Sequence[str]) -> TrainConfig:
    """The config of cartpole-train on the nominal cart. Raises ConfigError and Hydra's errors."""
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
        config = compose("train", [*overrides, "randomization=none"])
    with open_dict(config):
        config.pop("hydra", None)
    return checked(TrainConfig, as_mapping(config))


def with_rod(config: TrainConfig, length: float) -> TrainConfig:
    """The config with a uniform rod of `length` m."""
    name = f"{length:.1f} m"
    return config.model_copy(update={"pole": PoleSettings(choices={name: Pole.rod(length)})})


def every_plant(overrides: Sequence[str]) -> Iterator[TrainConfig]:
    """The plants that agents are judged on: both poles, and nine rods."""
    for pole in POLES:
        yield composed([*overrides, f"pole={pole}"])
    for length in LENGTHS:
        yield with_rod(composed(overrides), length)


def told(name: str, found: dict[str, Any]) -> str:
    """One line a start."""
    lines = [f"{name}: {found['score']:.0f} on average, {found['states']} states, {found['seconds']:.0f} s"]
    for start, figures in found["starts"].items():
        upright = figures["time_to_upright_s"]
        lines.append(
            f"  from {start}: {figures['score']:.0f}, "
            + ("never upright" if upright is None else f"upright after {upright:.2f} s")
            + f", still in {100 * figures['still_fraction_of_upright']:.1f} % of its upright steps"
        )
    return "\n".join(lines)


def main() -> None:
    """Search, tell, and add to a JSON file, where the plants' names are the keys."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", help="as for cartpole-train")
    parser.add_argument("--states", type=int, default=3000, help="of the widest search; 3000 if not given")
    parser.add_argument("--length", type=float, metavar="M", help="a uniform rod in place of the pole")
    parser.add_argument("--all", action="store_true", help="both poles and rods of 0.2 to 1.0 m")
    parser.add_argument("--json", type=Path, metavar="FILE", help="add to FILE what was found")
    given = parser.parse_args()
    torch.set_num_threads(1)
    try:
        if given.states < 1:
            raise ConfigError(f"--states {given.states} must be at least 1")
        if given.length is not None and not given.length > 0:
            raise ConfigError(f"--length {given.length:g} must be above 0")
        if given.all:
            plants = list(every_plant(given.overrides))
        else:
            plants = [composed(given.overrides)]
            if given.length is not None:
                plants = [with_rod(plants[0], given.length)]
    except (CartPoleError, HydraException, OmegaConfBaseException) as error:
        sys.exit(f"reference: {error}")
    for config in plants:
        found = reference(config, given.states)
        print(told(config.pole.name, found), flush=True)
        if given.json:
            known = json.loads(given.json.read_text()) if given.json.exists() else {}
            known[config.pole.name] = found
            given.json.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
