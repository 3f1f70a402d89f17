"""JavaScript's expression of each operation. Floats have 64 bits; integers are exact up to 32 bits."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from cartpole_rl.arithmetic.writer import Line, Operand

LOGICAL = {"bitwise_and": "{0} && {1}", "bitwise_or": "{0} || {1}"}
EXPRESSIONS = {
    "abs": "Math.abs({0})",
    "add": "{0} + {1}",
    "bitwise_and": "{0} & {1}",
    "bitwise_not": "~{0}",
    "bitwise_or": "{0} | {1}",
    "clamp": "clamped({0}, {1}, {2})",
    "copysign": "copysign({0}, {1})",
    "cos": "Math.cos({0})",
    "div": "{0} / {1}",
    "div_by_number": "{0} / {1}",
    "eq": "{0} == {1}",
    "exp": "Math.exp({0})",
    "ge": "{0} >= {1}",
    "gt": "{0} > {1}",
    "le": "{0} <= {1}",
    "logical_not": "!{0}",
    "lt": "{0} < {1}",
    "mul": "{0} * {1}",
    "nan_to_num": "finite({0}, {1}, {2}, {3})",
    "ne": "{0} != {1}",
    "neg": "-{0}",
    "reciprocal": "1 / {0}",
    "remainder": "remainder({0}, {1})",
    "round": "rounded({0})",
    "rsub": "{1} - {0}",
    "sigmoid": "1 / (1 + Math.exp(-{0}))",
    "sign": "sign({0})",
    "sin": "Math.sin({0})",
    "square": "{0} * {0}",
    "sub": "{0} - {1}",
    "tanh": "Math.tanh({0})",
    "to_bool": "{0} != 0",
    "to_float": "Number({0})",
    "to_int": "Math.trunc({0})",
    "where": "{0} ? {1} : {2}",
}
HELPERS = """\
function clamped(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
function copysign(value, sign) {
  const negative = sign < 0 || Object.is(sign, -0);
  return negative ? -Math.abs(value) : Math.abs(value);
}
function finite(value, ofNan, ofInfinity, ofMinusInfinity) {
  if (Number.isFinite(value)) return value;
  return Number.isNaN(value) ? ofNan : value > 0 ? ofInfinity : ofMinusInfinity;
}
function remainder(value, by) {
  const rest = value % by;
  return rest !== 0 && rest < 0 !== by < 0 ? rest + by : rest;
}
function rounded(value) {
  const below = Math.floor(value), rest = value - below;
  return rest < 0.5 || (rest === 0.5 && below % 2 === 0) ? below : below + 1;
}
function sign(value) {
  return (value > 0) - (value < 0);
}
"""


def expression(operation: str, operands: Sequence[Operand], kind: type) -> str:
    """Return the expression of an operation. Raises KeyError if it is not known."""
    table = EXPRESSIONS | LOGICAL if kind is bool else EXPRESSIONS
    return table[operation].format(*(spelled(operand.value) for operand in operands))


def spelled(value: Any) -> str:
    """Return a variable's name, or a number, in parentheses if it is negative."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "(-Infinity)"
    return f"({value!r})" if value < 0 else repr(value)


def declared(lines: Iterable[Line]) -> list[str]:
    """Return the declarations of the variables of lines."""
    return [f"const {line.name} = {line.expression};" for line in lines]
