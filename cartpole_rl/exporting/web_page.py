"""An agent as a web page: it drives a simulated cart that the reader pushes.

The page is one file. Its physics, observation and track guard are written from the functions of the
simulation (`plants/simulated.py`, `envs/perception.py`). It computes in float64.
"""

import base64
import html
import json
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cartpole_rl.arithmetic.languages import JAVASCRIPT
from cartpole_rl.arithmetic.writer import Writer
from cartpole_rl.drawing.pages import shared_parts
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import FLOATS, ExportedAgent
from cartpole_rl.exporting.code import COUNT, NUMBER, Graph, filled, perception
from cartpole_rl.physics.dynamics import Addition, Drive, State
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.settings import SimulationSettings
from cartpole_rl.plants.simulated import Carts, Inputs, Period, commands_under_way, encoder_counts, run_carts
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.tasks.settings import Start

LONGEST_LATENCY = 0.04  # s, that the reader can choose
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
    """What the reader does to the cart in a period."""

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
    parts = {**shared_parts(), "page": filled("page.js", {})}
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

    drive = torch.zeros(1 + commands_under_way(LONGEST_LATENCY, period), 1)
    carts = Carts(torch.ones(len(CartParameters.names()), 1), torch.zeros(4, 1), drive)
    return Graph.of(run, carts, Inputs(COUNT, torch.zeros(3, 1)), Push(NUMBER, NUMBER))


def function(name: str, graph: Graph) -> str:
    """Return a graph as a function of arrays of numbers, in the order of its inputs, that returns arrays."""
    writer = Writer(JAVASCRIPT)
    variables = [writer.variables(f"{each}[{{0}}]", example) for each, example in graph.inputs.items()]
    results = writer.write(graph.trace.graph, variables)
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
        "commands": commands_under_way(LONGEST_LATENCY, about.control_period),
        "longestLatency": LONGEST_LATENCY,
    }
    return json.dumps(content)


def encoded(values: Any) -> str:
    """Return float32 numbers in base64, little-endian."""
    return base64.b64encode(np.ascontiguousarray(values, FLOATS).tobytes()).decode()


def words(agent: ExportedAgent) -> dict[str, str]:
    """Return the texts of the page."""
    about = agent.description
    low, high = about.pole_lengths
    lengths = f"{low:.2f} m" if low == high else f"{low:.2f} to {high:.2f} m"
    return {"origin": html.escape(about.origin), "checksum": agent.checksum, "lengths": lengths}
