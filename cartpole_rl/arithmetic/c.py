"""C99's expression of each operation, in float, int64_t and bool, without implicit conversions."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from cartpole_rl.arithmetic.writer import Line, Operand

TYPES = {bool: "bool", float: "float", int: "int64_t"}
LOGICAL = {"bitwise_and": "{0} && {1}", "bitwise_or": "{0} || {1}", "logical_not": "!{0}"}
COMPARISONS = {"eq": "==", "ge": ">=", "gt": ">", "le": "<=", "lt": "<", "ne": "!="}
CONVERSIONS = ("to_bool", "to_float", "to_int")
EXPRESSIONS = {
    "add": "{0} + {1}",
    "bitwise_and": "{0} & {1}",
    "bitwise_not": "~{0}",
    "bitwise_or": "{0} | {1}",
    "mul": "{0} * {1}",
    "neg": "-{0}",
    "rsub": "{1} - {0}",
    "square": "{0} * {0}",
    "sub": "{0} - {1}",
}
FLOATS = {
    "abs": "fabsf({0})",
    "clamp": "clamped({0}, {1}, {2})",
    "copysign": "copysignf({0}, {1})",
    "cos": "cosf({0})",
    "div": "{0} / {1}",
    "div_by_number": "{0} / {1}",
    "exp": "expf({0})",
    "reciprocal": "1.0f / {0}",
    "round": "rintf({0})",
    "sigmoid": "1.0f / (1.0f + expf(-{0}))",
    "sign": "sign({0})",
    "sin": "sinf({0})",
    "tanh": "tanhf({0})",
}
HELPERS = {  # defined where a line calls them
    "clamped(": """\
static float clamped(float value, float low, float high)
{
    if (isnan(value) || isnan(low) || isnan(high)) {
        return NAN;
    }
    return value > low ? (value < high ? value : high) : (low < high ? low : high);
}
""",
    "sign(": """\
static float sign(float value)
{
    return (float)(value > 0.0f) - (float)(value < 0.0f);
}
""",
}


def expression(operation: str, operands: Sequence[Operand], kind: type) -> str:
    """Return an expression of type `kind`. Raises KeyError for an operation that is not known."""
    if operation == "where":
        condition, *choices = operands
        chosen, other = (cast(each, kind) for each in choices)
        return f"{cast(condition, bool)} ? {chosen} : {other}"
    if operation in COMPARISONS:
        common = float if any(operand.kind is float for operand in operands) else int
        left, right = (cast(operand, common) for operand in operands)
        return f"{left} {COMPARISONS[operation]} {right}"
    if operation in CONVERSIONS:
        return cast(operands[0], kind)
    table = LOGICAL if kind is bool else FLOATS | EXPRESSIONS if kind is float else EXPRESSIONS
    return table[operation].format(*(cast(operand, kind) for operand in operands))


def cast(operand: Operand, kind: type) -> str:
    """Return an operand as an expression of type `kind`."""
    if not isinstance(operand.value, str):
        return literal(kind(operand.value))
    if operand.kind is kind:
        return operand.value
    return f"({operand.value} != 0)" if kind is bool else f"({TYPES[kind]}){operand.value}"


def literal(value: Any) -> str:
    """Return a number, in parentheses if it is negative."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"({value})" if value < 0 else f"{value}"
    if not math.isfinite(value):
        return "NAN" if math.isnan(value) else "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value!r}f)" if value < 0 else f"{value!r}f"


def declared(lines: Iterable[Line]) -> list[str]:
    """Return the declarations of the variables of lines."""
    return [f"const {TYPES[line.kind]} {line.name} = {line.expression};" for line in lines]
