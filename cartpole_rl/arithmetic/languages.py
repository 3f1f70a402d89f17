"""The languages of plain arithmetic: Python, JavaScript and C99.

A language writes an operation of PyTorch, by its name in ATen, as an expression of the operands {0}, {1} and
so on. Python and JavaScript compute in float64; JavaScript's integers are exact up to 32 bits. C computes in
float, int64_t and bool, without implicit conversions.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

SMALLEST_INTEGER = -(2**63)  # PyTorch's for numbers that are too large
LARGEST_EXPONENT = 709.0  # of e, in a float
COMPARISONS = {"eq": "==", "ge": ">=", "gt": ">", "le": "<=", "lt": "<", "ne": "!="}
EXACT = {  # on integers, alike in all languages
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
LOGICAL = {  # on booleans
    "add": "{0} || {1}",
    "bitwise_and": "{0} && {1}",
    "bitwise_or": "{0} || {1}",
    "logical_not": "!{0}",
    "mul": "{0} && {1}",
}
OPERATIONS: dict[str, tuple[str, ...]] = {  # in Python, in JavaScript and, if C has it, on floats in C
    "abs": ("abs({0})", "Math.abs({0})", "fabsf({0})"),
    "clamp": ("clamped({0}, {1}, {2})", "clamped({0}, {1}, {2})", "clamped({0}, {1}, {2})"),
    "copysign": ("copysign({0}, {1})", "copysign({0}, {1})", "copysignf({0}, {1})"),
    "cos": ("cosine({0})", "Math.cos({0})", "cosf({0})"),
    "div": ("divide({0}, {1})", "{0} / {1}", "{0} / {1}"),
    "div_by_number": ("{0} / {1}", "{0} / {1}", "{0} / {1}"),
    "exp": ("exponential({0})", "Math.exp({0})", "expf({0})"),
    "logical_not": ("not {0}", "!{0}"),
    "nan_to_num": ("finite({0}, {1}, {2}, {3})", "finite({0}, {1}, {2}, {3})"),
    "reciprocal": ("divide(1.0, {0})", "1 / {0}", "1.0f / {0}"),
    "remainder": ("remainder({0}, {1})", "remainder({0}, {1})"),
    "round": ("rounded({0})", "rounded({0})", "rintf({0})"),
    "sigmoid": ("sigmoid({0})", "1 / (1 + Math.exp(-{0}))", "1.0f / (1.0f + expf(-{0}))"),
    "sign": ("sign({0})", "sign({0})", "sign({0})"),
    "sin": ("sine({0})", "Math.sin({0})", "sinf({0})"),
    "tanh": ("tanh({0})", "Math.tanh({0})", "tanhf({0})"),
    "to_bool": ("{0} != 0", "{0} != 0"),
    "to_float": ("float({0})", "Number({0})"),
    "to_int": ("integer({0})", "Math.trunc({0})"),
    "where": ("{1} if {0} else {2}", "{0} ? {1} : {2}"),
    **{name: (f"{{0}} {sign} {{1}}", f"{{0}} {sign} {{1}}") for name, sign in COMPARISONS.items()},
}


class Operand(NamedTuple):
    """An operand of an expression: a number, or the name of a variable, of Python's type `kind`."""

    value: Any
    kind: type


class Line(NamedTuple):
    """A variable and the expression that it holds."""

    name: str
    kind: type  # bool, int or float
    expression: str


class Python:
    """Python, and what all languages share. The expressions call FUNCTIONS."""

    column = 0  # of OPERATIONS
    # expressions on booleans that are others than on integers
    logical: Mapping[str, str] = {"add": "{0} or {1}", "mul": "{0} and {1}"}

    def __init__(self) -> None:
        place = self.column
        self.table = EXACT | {name: row[place] for name, row in OPERATIONS.items() if len(row) > place}

    def expression(self, operation: str, operands: Sequence[Operand], kind: type) -> str:
        """Return an expression of type `kind`. Raises KeyError for an operation that is not known."""
        table = {**self.table, **self.logical} if kind is bool else self.table
        return table[operation].format(*(self.text(operand.value) for operand in operands))

    def text(self, value: Any) -> str:
        """Return the name of a variable, or a number."""
        return value if isinstance(value, str) else self.literal(value)

    def literal(self, value: Any) -> str:
        """Return a number in parentheses."""
        return f"({value!r})"

    def declaration(self, line: Line) -> str:
        """Return the statement that declares the variable of a line."""
        return f"{line.name} = {line.expression}"


class JavaScript(Python):
    """JavaScript. The expressions call the functions of exporting/templates/arithmetic.js."""

    column, logical = 1, LOGICAL

    def literal(self, value: Any) -> str:
        """Return a number, in parentheses if it is negative."""
        return _literal(value, "NaN", "Infinity")

    def declaration(self, line: Line) -> str:
        """Return the declaration of a constant."""
        return f"const {line.name} = {line.expression};"


class C(Python):
    """C99. The expressions call the functions of exporting/templates/clamped.c and sign.c."""

    column, logical = 2, LOGICAL
    types: Mapping[type, str] = {bool: "bool", float: "float", int: "int64_t"}

    def expression(self, operation: str, operands: Sequence[Operand], kind: type) -> str:
        """Return an expression whose operands are cast to the type that the operation needs."""
        if operation == "where":
            condition, *choices = operands
            chosen, other = (self.cast(each, kind) for each in choices)
            return f"{self.cast(condition, bool)} ? {chosen} : {other}"
        if operation in COMPARISONS:
            common = float if any(operand.kind is float for operand in operands) else int
            left, right = (self.cast(operand, common) for operand in operands)
            return f"{left} {COMPARISONS[operation]} {right}"
        if operation in ("to_bool", "to_float", "to_int"):
            return self.cast(operands[0], kind)
        if operation == "remainder" and kind is int and isinstance(operands[1].value, int):
            value, by = (self.cast(operand, int) for operand in operands)
            return f"({value} % {by} + {by}) % {by}"  # C rounds a quotient towards 0
        table = self.logical if kind is bool else self.table if kind is float else EXACT
        return table[operation].format(*(self.cast(operand, kind) for operand in operands))

    def cast(self, operand: Operand, kind: type) -> str:
        """Return an operand as an expression of type `kind`."""
        if not isinstance(operand.value, str):
            return self.literal(kind(operand.value))
        if operand.kind is kind:
            return operand.value
        return f"({operand.value} != 0)" if kind is bool else f"({self.types[kind]}){operand.value}"

    def literal(self, value: Any) -> str:
        """Return a number, in parentheses if it is negative."""
        return _literal(value, "NAN", "INFINITY", "f")

    def declaration(self, line: Line) -> str:
        """Return the declaration of a constant of the type of the line."""
        return f"const {self.types[line.kind]} {line.name} = {line.expression};"


def _literal(value: Any, nan: str, infinity: str, suffix: str = "") -> str:
    """Return a number, in parentheses if it is negative; floats end with `suffix`."""
    if isinstance(value, bool):
        return str(value).lower()
    if math.isfinite(value):
        text = f"{value!r}{suffix if isinstance(value, float) else ''}"
    else:
        text = nan if math.isnan(value) else "-" * (value < 0) + infinity
    return f"({text})" if value < 0 else text


def divide(value: float, by: float) -> float:
    """Return a quotient, also by zero."""
    if by:
        return value / by
    return math.nan if value == 0 or value != value else math.copysign(math.inf, value) * math.copysign(1, by)


def clamped(value: float, low: float, high: float) -> float:
    """Return `value` within bounds, `high` if they are crossed; NaN if any of the three is."""
    if value != value or low != low or high != high:
        return math.nan
    return min(max(value, low), high)


def integer(value: float) -> int:
    """Return the whole part, and the smallest integer for a number that no int64 can hold."""
    return int(value) if -(2.0**63) <= value < 2.0**63 else SMALLEST_INTEGER


def finite(value: float, of_nan: float, of_inf: float, of_minus_inf: float) -> float:
    """Return `value`, or the number that replaces NaN or an infinity."""
    if math.isfinite(value):
        return value
    return of_nan if value != value else of_inf if value > 0 else of_minus_inf


def periodic(function: Callable[[float], float]) -> Callable[[float], float]:
    """Return sine or cosine that is NaN for infinities."""
    return lambda angle: function(angle) if math.isfinite(angle) else math.nan


def exponential(value: float) -> float:
    """Return e to the power of `value`; infinite if it is too large for a float."""
    return math.exp(value) if value < LARGEST_EXPONENT or value != value else math.inf


FUNCTIONS: dict[str, Any] = {  # that Python's expressions call
    "__builtins__": {"abs": abs, "float": float},
    "nan": math.nan,
    "inf": math.inf,
    "clamped": clamped,
    "copysign": math.copysign,
    "cosine": periodic(math.cos),
    "divide": divide,
    "exponential": exponential,
    "finite": finite,
    "integer": integer,
    "remainder": lambda value, by: value % by if by else math.nan,
    "rounded": lambda value: math.copysign(round(value), value) if math.isfinite(value) else value,
    "sigmoid": lambda value: 1 / (1 + exponential(-value)),
    "sign": lambda value: (value > 0) - (value < 0),
    "sine": periodic(math.sin),
    "tanh": math.tanh,
}
PYTHON, JAVASCRIPT, C99 = Python(), JavaScript(), C()
