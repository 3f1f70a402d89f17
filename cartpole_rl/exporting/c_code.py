"""An agent as C99: tables of weights, and the functions from encoder counts to a motor value.

State, observation and track guard are written from the functions that simulation and cart use
(`envs/perception.py`), so they are defined once.
"""

import math
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from cartpole_rl.arithmetic.languages import C99, Operand
from cartpole_rl.arithmetic.writer import Expressions, Writer
from cartpole_rl.emulator.c_firmware import in_comment
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import ExportedAgent, Floats
from cartpole_rl.exporting.code import Graph, filled, perception
from cartpole_rl.tasks.settings import Start

FLOAT_BYTES, MOTOR_BYTES = 4, 2
MEMORY_BYTES = 36  # of policy_t without `past`
PLACES = {  # of the inputs, in C
    "last_counts": "policy->counts[{0}]",
    "state": "policy->state[{0}]",
    "past": "policy->past[{0}]",
    "motor": "policy->motor",
    "pole_length": "policy->pole_length",
    "track_end": "policy->track_end",
    "counts": "counts[{0}]",
    "dt": "dt",
}
BUFFERS = ("even", "odd")  # in C, of every other hidden layer
WIDTH = 104


def c_files(agent: ExportedAgent, settings: CartPoleSettings) -> dict[str, str]:
    """Return the files of an agent that was trained with `settings`, by name.

    Raises ConfigError for an observation that cannot be written in C.
    """
    try:
        first, later = map(body, perception(settings, agent.description.guard))
    except NotImplementedError as error:
        raise ConfigError(f"format=c: the observation has an operation that is not known: {error}") from None
    return {"policy.h": header(agent, later), "policy.c": source(agent, first, later)}


def body(graph: Graph) -> str:
    """Return the statements of a function that perceives."""
    writer = Writer(C99)
    named = {name: writer.variables(f"{name}_{{0}}", example) for name, example in graph.inputs.items()}
    results = writer.write(graph.trace, list(named.values()))
    percept = graph.trace.result(results)

    def in_c(value: Any, kind: type) -> str:
        return C99.cast(Operand(value, writer.kind(value)), kind)

    def assigned(array: str, values: Expressions) -> list[str]:
        return [f"{array}[{place}] = {in_c(value, float)};" for place, value in enumerate(values.reshape(-1))]

    statements = [
        *writer.statements(results),
        *assigned("policy->state", percept.state),
        *assigned("policy->past", percept.past),
        *assigned("observation", percept.observation),
        f"return {in_c(percept.guard.item(), int)};",
    ]
    text = "\n".join(statements)
    read = [
        f"const {C99.types[writer.kind(variable)]} {variable} = {PLACES[name].format(place)};"
        for name, variables in named.items()
        for place, variable in enumerate(variables.reshape(-1))
        if re.search(rf"\b{variable}\b", text)
    ]
    return textwrap.indent("\n".join((*read, text)), "    ")


def header(agent: ExportedAgent, later: str) -> str:
    """Return policy.h."""
    about = agent.description
    past = max(1, about.observation.past_size)
    weights = sum(values.size for _, values in agent.arrays())
    buffers = about.sizes[0] + about.sizes[-1] + sum(buffer_sizes(about.sizes).values())
    norms = about.layer_norm * about.norm_groups * (len(about.sizes) - 2)
    values = {
        "flash": FLOAT_BYTES * weights + MOTOR_BYTES * (len(about.motors) + 2),
        "ram": MEMORY_BYTES + FLOAT_BYTES * past,
        "stack": FLOAT_BYTES * buffers,
        "operations": sum(layer.weight.size for layer in agent.layers),
        "roots": norms,
        "trigonometry": len(re.findall(r"\b(sinf|cosf)\(", later)),
        "period_ms": f"{1e3 * about.control_period:g}",
        "period_us": round(1e6 * about.control_period),
        "guard": about.guard or "none",
        "origin": in_comment(about.origin),
        "checksum": agent.checksum,
        "id": f"{agent.identity:08x}",
        "inputs": about.sizes[0],
        "actions": len(about.motors),
        "nanometres": round(1e9 * about.cart_metres_per_count),
        "counts_per_turn": about.pole_counts_per_turn,
        "track": C99.literal(about.track_half_length),
        "past": past,
        "observes_length": int(about.observation.pole_length),
        "starts_upright": int(about.start == Start.UPRIGHT),
        "length_use": "above 0 and at most 3, or every motor value is 0."
        if about.observation.pole_length
        else "not read by this agent.",
    }
    return filled("policy.h", values)


def source(agent: ExportedAgent, first: str, later: str) -> str:
    """Return policy.c."""
    about = agent.description
    helpers = [filled(f"{name}.c", {}) for name in ("clamped", "sign") if f"{name}(" in first + later]
    values = {
        "id": f"{agent.identity:08x}",
        "motors": ", ".join(map(str, about.motors)),
        "rightmost": max(0, *about.motors),
        "leftmost": min(0, *about.motors),
        "angle_limit": C99.literal(math.inf if about.angle_limit is None else about.angle_limit),
        "tables": "\n\n".join(table(name, values) for name, values in agent.arrays()),
        "helpers": "".join(f"{text}\n" for text in helpers),
        "first": first,
        "later": later,
        "layers": "\n\n".join(layer_functions(agent)),
        "network": textwrap.indent("\n".join(network(agent)), "    "),
    }
    return filled("policy.c", values)


def layer_functions(agent: ExportedAgent) -> Iterable[str]:
    """Yield the functions that the layers need."""
    yield filled("linear.c", {})
    if any(layer.gain is not None for layer in agent.layers):
        yield filled("normalize.c", {"epsilon": C99.literal(agent.description.norm_epsilon)})
    if len(agent.layers) > 1:
        yield filled("rectify.c", {})


def network(agent: ExportedAgent) -> Iterable[str]:
    """Yield the statements that compute `values`, the action values of `observation`."""
    groups, last = agent.description.norm_groups, len(agent.layers) - 1
    for name, size in buffer_sizes(agent.description.sizes).items():
        yield f"float {name}[{size}];"
    yield "float values[POLICY_ACTIONS];"
    source, inputs = "observation", "POLICY_INPUTS"
    for number, (layer, size) in enumerate(zip(agent.layers, agent.description.sizes[1:], strict=True)):
        prefix = f"LAYER{number}"
        target = "values" if number == last else BUFFERS[number % 2]
        yield f"linear({prefix}_WEIGHT, {prefix}_BIAS, {source}, {inputs}, {target}, {size});"
        if layer.gain is not None:
            part = size // groups
            for start in range(0, size, part):
                gain, shift = (f"{prefix}_{name} + {start}" for name in ("GAIN", "SHIFT"))
                yield f"normalize({target} + {start}, {part}, {gain}, {shift});"
        if number < last:
            yield f"rectify({target}, {size});"
        source, inputs = target, str(size)


def buffer_sizes(sizes: Sequence[int]) -> dict[str, int]:
    """Return the sizes of the buffers that hold the hidden layers in turn."""
    return {name: max(hidden) for parity, name in enumerate(BUFFERS) if (hidden := sizes[1:-1][parity::2])}


def table(name: str, values: Floats) -> str:
    """Return the definition of an array; its numbers are exact."""
    numbers = " ".join(f"{number!s}f," for number in values.reshape(-1))
    rows = textwrap.indent(textwrap.fill(numbers, WIDTH, break_on_hyphens=False), "    ")
    return f"static const float {name.replace('.', '_').upper()}[{values.size}] = {{\n{rows}\n}};"
