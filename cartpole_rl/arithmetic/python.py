"""Python's expression of each operation. Floats have 64 bits."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cartpole_rl.arithmetic.writer import Operand

SMALLEST_INTEGER = -(2**63)  # PyTorch's for numbers that are too large
LARGEST_EXPONENT = 709.0  # of e, in a float


def expression(operation: str, operands: "Sequence[Operand]", kind: type) -> str:
    """Return the expression of an operation. Raises KeyError if it is not known."""
    return EXPRESSIONS[operation].format(*(spelled(operand.value) for operand in operands))


def evaluate(operation: str, operands: "Sequence[Operand]", kind: type) -> Any:
    """Return the result of an operation on numbers."""
    return eval(expression(operation, operands, kind), dict(FUNCTIONS))


def spelled(value: Any) -> str:
    """Return a variable's name, or a number in parentheses."""
    return value if isinstance(value, str) else f"({value!r})"


def divide(value: float, by: float) -> float:
    """Return a quotient, also by zero."""
    if by:
        return value / by
    return math.nan if value == 0 or value != value else math.copysign(math.inf, value) * math.copysign(1, by)


def remainder(value: float, by: float) -> float:
    """Return the remainder with the sign of `by`."""
    return value % by if by else math.nan


def clamped(value: float, low: float, high: float) -> float:
    """Return `value` within bounds, `high` if they are crossed; NaN if any of the three is."""
    if value != value or low != low or high != high:
        return math.nan
    return min(max(value, low), high)


def sign(value: float) -> int:
    """Return 1, 0 or -1; 0 for NaN."""
    return (value > 0) - (value < 0)


def rounded(value: float) -> float:
    """Return the nearest whole number, of two the even one."""
    return math.copysign(round(value), value) if math.isfinite(value) else value


def integer(value: float) -> int:
    """Return the whole part, and the smallest integer for a number that no int64 can hold."""
    inside = -(2.0**63) <= value < 2.0**63
    return int(value) if inside else SMALLEST_INTEGER


def finite(value: float, of_nan: float, of_inf: float, of_minus_inf: float) -> float:
    """Return `value`, or what replaces NaN or an infinity."""
    if math.isfinite(value):
        return value
    return of_nan if value != value else of_inf if value > 0 else of_minus_inf


def periodic(function: Callable[[float], float]) -> Callable[[float], float]:
    """Return sine or cosine that is NaN for infinities."""

    def at(angle: float) -> float:
        return function(angle) if math.isfinite(angle) else math.nan

    return at


def exponential(value: float) -> float:
    """Return e to the power of `value`; infinite if it is too large for a float."""
    return math.exp(value) if value < LARGEST_EXPONENT or value != value else math.inf


def sigmoid(value: float) -> float:
    """Return the logistic function."""
    return 1 / (1 + exponential(-value))


FUNCTIONS: dict[str, Any] = {
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
    "remainder": remainder,
    "rounded": rounded,
    "sigmoid": sigmoid,
    "sign": sign,
    "sine": periodic(math.sin),
    "tanh": math.tanh,
}
EXPRESSIONS = {
    "abs": "abs({0})",
    "add": "{0} + {1}",
    "bitwise_and": "{0} & {1}",
    "bitwise_not": "~{0}",
    "bitwise_or": "{0} | {1}",
    "clamp": "clamped({0}, {1}, {2})",
    "copysign": "copysign({0}, {1})",
    "cos": "cosine({0})",
    "div": "divide({0}, {1})",
    "div_by_number": "{0} / {1}",
    "eq": "{0} == {1}",
    "exp": "exponential({0})",
    "ge": "{0} >= {1}",
    "gt": "{0} > {1}",
    "le": "{0} <= {1}",
    "logical_not": "not {0}",
    "lt": "{0} < {1}",
    "mul": "{0} * {1}",
    "nan_to_num": "finite({0}, {1}, {2}, {3})",
    "ne": "{0} != {1}",
    "neg": "-{0}",
    "reciprocal": "divide(1.0, {0})",
    "remainder": "remainder({0}, {1})",
    "round": "rounded({0})",
    "rsub": "{1} - {0}",
    "sigmoid": "sigmoid({0})",
    "sign": "sign({0})",
    "sin": "sine({0})",
    "square": "{0} * {0}",
    "sub": "{0} - {1}",
    "tanh": "tanh({0})",
    "to_bool": "{0} != 0",
    "to_float": "float({0})",
    "to_int": "integer({0})",
    "where": "{1} if {0} else {2}",
}
