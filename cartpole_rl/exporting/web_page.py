"""An agent as a web page: it drives a simulated cart that the reader pushes.

The page is one file. Its physics, observation and track guard are written from the functions of the
simulation (`plants/simulated.py`, `envs/perception.py`). It computes in float64.
"""

import base64
import html
import json
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cartpole_rl.arithmetic.languages import JAVASCRIPT
from cartpole_rl.arithmetic.writer import Writer
from cartpole_rl.drawing import shared_parts
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import FLOATS, ExportedAgent
from cartpole_rl.exporting.code import COUNT, NUMBER, Graph, filled, perception
from cartpole_rl.physics.dynamics import Addition, Drive, State
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.serial.cart import LEASE_RENEWAL_US, LONGEST_STOP, LONGEST_SUSPENSION
from cartpole_rl.plants.serial.connection import ACKNOWLEDGED_STOPS, LONGEST_DEAFNESS, ROUND_TRIPS
from cartpole_rl.plants.serial.errors import FAULTS, REASONS, limit_range
from cartpole_rl.plants.serial.preparation import OFF_CENTRE, POSITIONS, STILL_SECONDS
from cartpole_rl.plants.serial.tracking import OVERTAKEN_TICKS
from cartpole_rl.plants.settings import SerialSettings, SimulationSettings
from cartpole_rl.plants.simulated import Carts, Inputs, Period, commands_under_way, encoder_counts, run_carts
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.tasks.settings import Start
from cartpole_rl.wire.frames import LONGEST_FRAME, VERSION
from cartpole_rl.wire.messages import MESSAGES, Fault, Flags, Reason

LONGEST_LATENCY = 0.04  # s, that the reader can choose, and the nominal one where that is longer
RODS = [length / 100 for length in range(20, 101, 4)]  # m, poles that the reader can choose


class TrueState(NamedTuple):
    """The inputs of the encoders."""

    table: Tensor  # [P, 1], one row per parameter
    motion: Tensor  # [4, 1]
    noise: Tensor  # [3, 1]


class Counts(NamedTuple):
    """The outputs of the encoders."""

    counts: Tensor  # [2, 1] int64


class Push(NamedTuple):
    """A push by the reader in a period."""

    force: Tensor  # [1, 1] N on the cart
    angular_acceleration: Tensor  # [1, 1] rad/s^2 of the pole


def web_page(agent: ExportedAgent, settings: CartPoleSettings, plant: SimulationSettings) -> str:
    """Return the page of an agent that was trained with `settings` on `plant`.

    Raises ConfigError for an observation that cannot be written in JavaScript.
    """
    try:
        first, later = perception(settings, agent.description.guard)
        functions = [
            function("perceiveFirst", first),
            function("perceive", later),
            function("encoderCounts", encoders(settings)),
            function("runPeriod", physics(settings, plant)),
        ]
    except NotImplementedError as error:
        raise ConfigError(f"format=web: the agent has an operation that is not known: {error}") from None
    script = filled("cart.js", {"data": data(agent, settings)})
    code = "\n".join((filled("arithmetic.js", {}), *functions, script))
    parts = {**shared_parts(), **{name: filled(f"{name}.js", {}) for name in ("page", "serial")}}
    return filled("cart.html", {"code": code, **parts, **words(agent)})


def encoders(settings: CartPoleSettings) -> Graph:
    """Return the function of the encoders."""

    def counted(true: TrueState) -> Counts:
        cart = CartParameters(true.table)
        motion = State(*true.motion.unbind(0))
        return Counts(encoder_counts(motion, cart, true.noise, settings.hardware.encoders))

    table = torch.ones(len(CartParameters.names()), 1)
    return Graph.of(counted, TrueState(table, torch.zeros(4, 1), torch.zeros(3, 1)))


def physics(settings: CartPoleSettings, plant: SimulationSettings) -> Graph:
    """Return the function of one control period of the simulated cart."""
    models, period = settings.models(plant), settings.control_period

    def run(carts: Carts, inputs: Inputs, push: Push) -> Period:
        def pushed(state: State, drive: Drive) -> Addition:
            return Addition(push.force[0], torch.zeros_like, push.angular_acceleration[0])

        return run_carts(
            carts,
            inputs,
            models=models,
            period=period,
            substeps=plant.substeps,
            encoders=settings.hardware.encoders,
            addition=pushed,
        )

    drive = torch.zeros(1 + commands_under_way(longest_latency(settings), period), 1)
    carts = Carts(torch.ones(len(CartParameters.names()), 1), torch.zeros(4, 1), drive)
    return Graph.of(run, carts, Inputs(COUNT, torch.zeros(3, 1)), Push(NUMBER, NUMBER))


def longest_latency(settings: CartPoleSettings) -> float:
    """Return the longest latency that the page simulates, s."""
    return max(LONGEST_LATENCY, settings.nominal_cart["latency"])


def function(name: str, graph: Graph) -> str:
    """Return a graph as a function of arrays of numbers, in the order of its inputs, that returns arrays."""
    writer = Writer(JAVASCRIPT)
    variables = [writer.variables(f"{each}[{{0}}]", example) for each, example in graph.inputs.items()]
    results = writer.write(graph.trace, variables)
    parts = [
        f"{key}: [{', '.join(map(JAVASCRIPT.text, values.reshape(-1)))}]"
        for key, values in graph.trace.result(results)._asdict().items()
    ]
    lines = (*writer.statements(results), f"return {{ {', '.join(parts)} }};")
    body = "\n".join(f"  {line}" for line in lines)
    return f"function {name}({', '.join(graph.inputs)}) {{\n{body}\n}}\n"


def data(agent: ExportedAgent, settings: CartPoleSettings) -> str:
    """Return the numbers of the agent and of the nominal cart as JSON."""
    about, pole = agent.description, settings.pole.nominal
    rods = [Pole.rod(length) for length in RODS if not pole.is_about(length)]
    poles = sorted([pole, *rods], key=lambda each: each.length)
    content: dict[str, Any] = {
        "layers": [
            {name: None if values is None else encoded(values) for name, values in layer._asdict().items()}
            for layer in agent.layers
        ],
        "groups": about.norm_groups,
        "epsilon": about.norm_epsilon,
        "motors": about.motors,
        "inward": [0, max(0, *about.motors), min(0, *about.motors)],
        "period": about.control_period,
        "pastSize": about.observation.past_size,
        "startsUpright": about.start == Start.UPRIGHT,
        "angleLimit": about.angle_limit,
        "names": CartParameters.names(),
        "cart": settings.nominal_with(pole),
        "poles": [each.model_dump() for each in poles],
        "trained": poles.index(pole),
        "commands": commands_under_way(longest_latency(settings), about.control_period),
        "longestLatency": longest_latency(settings),
        "wire": wire(settings),
    }
    return json.dumps(content)


def wire(settings: CartPoleSettings) -> dict[str, Any]:
    """Return the numbers by which the page talks to a real cart, those of `wire` and of `plants.serial`."""
    hardware, host = settings.hardware, SerialSettings(port="auto")
    task = settings.task.at(settings.control_period)
    position = POSITIONS["upright" if task.evaluation_start.angle == Start.UPRIGHT else "hanging"]
    return {
        "version": VERSION,
        "longestFrame": LONGEST_FRAME,
        "messages": {
            kind.TYPE.name: {
                "type": kind.TYPE,
                "layout": kind.LAYOUT,
                "fields": [each.name for each in fields(kind)],  # type: ignore[arg-type]
            }
            for kind in MESSAGES.values()
        },
        "flags": {flag.name: flag for flag in Flags},
        "faults": FAULTS,
        "hardLimit": Fault.HARD_LIMIT,
        "reasons": REASONS,
        "busy": Reason.BUSY,
        "stale": Reason.STALE,
        "cart": {
            "pole_counts_per_turn": hardware.pole_counts_per_turn,
            "cart_nanometres_per_count": hardware.cart_nanometres_per_count,
            "motor_limit": LARGEST_MOTOR,
            "switches": hardware.switches * Flags.LEFT_SWITCH,
        },
        "metres": hardware.encoders.metres,
        "turn": hardware.encoders.turn,
        "limits": limit_range(hardware),
        "period": round(settings.control_period * 1e6),
        "periods": task.periods,
        "baud": host.baud,
        "timeout": host.timeout,
        "answerTimeout": host.answer_timeout,
        "attempts": 1 + host.retries,
        "connectAttempts": round(host.connect_timeout / host.answer_timeout),
        "stopAttempts": round(LONGEST_STOP / host.answer_timeout),
        "homeTimeout": max(host.home_timeout, 60 + 20 * hardware.track_span),
        "startTimeout": host.start_timeout,
        "needsLength": settings.observation.pole_length,
        "start": asdict(position),
        "still": STILL_SECONDS,
        "offCentre": hardware.encoders.cart_counts(OFF_CENTRE * hardware.half_span),
        "stops": ACKNOWLEDGED_STOPS,
        "lease": LEASE_RENEWAL_US,
        "overtaken": OVERTAKEN_TICKS,
        "trips": ROUND_TRIPS,
        "suspension": LONGEST_SUSPENSION,
        "deafness": LONGEST_DEAFNESS,
    }


def encoded(values: Any) -> str:
    """Return float32 numbers in base64, little-endian."""
    return base64.b64encode(np.ascontiguousarray(values, FLOATS).tobytes()).decode()


def words(agent: ExportedAgent) -> dict[str, str]:
    """Return the texts of the page."""
    about = agent.description
    low, high = about.pole_lengths
    lengths = f"{low:.2f} m" if low == high else f"{low:.2f} to {high:.2f} m"
    does = "balances the pole" if about.start == Start.UPRIGHT else "swings the pole up and balances it"
    return {"origin": html.escape(about.origin), "checksum": agent.checksum, "lengths": lengths, "does": does}
