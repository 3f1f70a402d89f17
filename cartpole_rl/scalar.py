"""Pure functions of tensors as plain Python arithmetic, for one cart.

PyTorch takes microseconds for each operation, whatever the number of carts; Python takes a hundredth of that
for a sum of two floats. A function is traced as in `compilation.py`. Its graph is then evaluated once on
arrays of expressions instead of numbers: operations on shapes move expressions about, and each arithmetic
operation on each number writes a line of Python. Python's floats have 64 bits, so results equal those of
float32 tensors up to rounding; NaN, infinities, division by zero and conversions behave as in PyTorch.

To support another operation of PyTorch, add it to `EXPRESSIONS`, `SHAPES` or `FILLED`, by its name in ATen.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import Node

from cartpole_rl.compilation import trace

Expressions = NDArray[np.object_]  # numbers, and names of variables
SMALLEST_INTEGER = -(2**63)  # PyTorch's for numbers that are too large
LARGEST_EXPONENT = 709.0  # of e, in a float
LARGEST_FLOAT = torch.finfo(torch.float32).max


class Scalar:
    """A pure `function` of tuples of tensors, named or plain, as arithmetic of Python's numbers.

    `examples` are arguments of the shapes and types to trace. Calls take and return the same tuples, with a
    flat sequence of numbers in place of each tensor. Whatever else `function` reads must not change.
    Raises NotImplementedError for an operation that is not known here.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], *examples: tuple[Tensor, ...]) -> None:
        with torch.no_grad():
            traced = trace(function, examples)
        self._result = traced.result
        self._compute = written(traced.graph, examples)

    def __call__(self, *arguments: Sequence[Sequence[float]]) -> Any:
        """Return the function's result."""
        return self._result(self._compute(*arguments))


def plain(tensor: Tensor) -> tuple[Any, ...]:
    """Return the numbers of a tensor, for a call of a `Scalar`."""
    return tuple(tensor.reshape(-1).tolist())


def written(graph: torch.fx.GraphModule, examples: Sequence[tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Return the Python function that computes the outputs of `graph`."""
    writer = Writer()
    values: dict[Node, Any] = {}
    inputs = [[writer.variables(tensor.shape) for tensor in example] for example in examples]
    unread = iter([each for example in inputs for each in example])
    for node in graph.graph.nodes:
        if node.op == "placeholder":
            values[node] = next(unread)
        elif node.op == "get_attr":
            values[node] = np.asarray(getattr(graph, node.target).numpy(), dtype=object)
        elif node.op == "output":
            outputs = [values[each] for each in node.args[0]]
        else:
            values[node] = writer.evaluate(node, values)
    return writer.function([[flat(each) for each in example] for example in inputs], map(flat, outputs))


def flat(values: Expressions) -> str:
    """Return a tuple display of all expressions."""
    return f"({''.join(f'{spelled(each)}, ' for each in values.reshape(-1))})"


class Writer:
    """The lines of a function that is being written."""

    def __init__(self) -> None:
        self._variables = 0
        self._names: dict[str, str] = {}  # of variables, by the expression that each one holds

    def variables(self, shape: Sequence[int]) -> Expressions:
        """Return names of new variables."""
        names = [self._new_name() for _ in range(math.prod(shape))]
        return np.array(names, dtype=object).reshape(tuple(shape))

    def _new_name(self) -> str:
        self._variables += 1
        return f"v{self._variables}"

    def evaluate(self, node: Node, values: dict[Node, Any]) -> Any:
        """Return the result of a node, after writing the lines that compute it."""
        arguments: Any = torch.fx.map_arg(node.args, values.__getitem__)
        named: Any = torch.fx.map_arg(node.kwargs, values.__getitem__)
        if node.target is operator.getitem:
            return arguments[0][arguments[1]]
        assert isinstance(node.target, OpOverload)
        name = node.target._schema.name.removeprefix("aten::")
        if name in SHAPES:
            return SHAPES[name](*arguments, **named)
        example = node.meta["val"]
        if name in FILLED:
            return np.full(tuple(example.shape), kind_of(example.dtype)(FILLED[name]), dtype=object)
        expression = expression_of(name, arguments, named, example.dtype)
        if expression is None:
            raise NotImplementedError(f"scalar.py does not know {node.target}; add it to EXPRESSIONS")
        return self._each(*expression)

    def _each(self, expression: str, operands: Sequence[Any]) -> Expressions:
        """Write `expression` of each of the broadcast `operands`; return what holds the results."""
        operands = [np.asarray(each, dtype=object) for each in operands]
        results = np.empty(np.broadcast_shapes(*(each.shape for each in operands)), dtype=object)
        for place, parts in zip(np.ndindex(results.shape), np.broadcast(*operands), strict=True):
            results[place] = self._write(expression, parts)
        return results

    def _write(self, expression: str, parts: Sequence[Any]) -> Any:
        """Write a line unless it is known; return its variable, or the number if all `parts` are numbers."""
        line = expression.format(*map(spelled, parts))
        if not any(isinstance(part, str) for part in parts):
            return eval(line, dict(FUNCTIONS))
        if line not in self._names:
            self._names[line] = self._new_name()
        return self._names[line]

    def function(self, inputs: Sequence[Sequence[str]], outputs: Any) -> Callable[..., Any]:
        """Return the function of the tuples `inputs` that returns the tuple `outputs`."""
        names = [f"argument_{number}" for number in range(len(inputs))]
        lines = [
            *(f"({', '.join(parts)},) = {name}" for name, parts in zip(names, inputs, strict=True)),
            *(f"{name} = {line}" for line, name in self._names.items()),
            f"return ({''.join(f'{each}, ' for each in outputs)})",
        ]
        namespace = dict(FUNCTIONS)
        exec("\n    ".join((f"def compute({', '.join(names)}):", *lines)), namespace)
        return namespace["compute"]


def spelled(part: Any) -> str:
    """Return a variable's name, or a number in parentheses."""
    return part if isinstance(part, str) else f"({part!r})"


def expression_of(
    name: str, arguments: Sequence[Any], named: Mapping[str, Any], dtype: torch.dtype
) -> tuple[str, Sequence[Any]] | None:
    """Return the expression of an arithmetic operation and its operands; None if it is not known.

    `dtype` is the type of the result.
    """
    if name == "_to_copy":
        return CONVERSIONS[kind_of(dtype)], arguments
    if name not in EXPRESSIONS or named or (name == "pow" and not is_two(arguments[1])):
        return None
    if name == "clamp":
        value, low, high = (*arguments, None, None)[:3]
        arguments = value, -math.inf if low is None else low, math.inf if high is None else high
    elif name == "nan_to_num":
        value, of_nan, of_inf, of_minus_inf = (*arguments, None, None, None)[:4]
        defaults = (0.0, LARGEST_FLOAT, -LARGEST_FLOAT)
        given = (of_nan, of_inf, of_minus_inf)
        arguments = value, *(b if a is None else a for a, b in zip(given, defaults, strict=True))
    elif name == "bitwise_not" and dtype is torch.bool:
        return "not {0}", arguments
    elif name == "div" and isinstance(arguments[1], int | float) and arguments[1]:
        return "{0} / {1}", arguments
    if len(arguments) > MOST_OPERANDS.get(name, 2):
        return None  # an option that is not known here, such as alpha
    return EXPRESSIONS[name], arguments


def is_two(exponent: Any) -> bool:
    """Return True for the number 2; an array of expressions is no number."""
    return isinstance(exponent, int | float) and exponent == 2


def kind_of(dtype: torch.dtype) -> type:
    """Return Python's type of the numbers of a tensor."""
    if dtype.is_floating_point:
        return float
    return bool if dtype is torch.bool else int


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


def placed(values: Any) -> Expressions:
    """Return an array of expressions; NumPy returns a single one without an array."""
    return np.asarray(values, dtype=object)


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
    "eq": "{0} == {1}",
    "exp": "exponential({0})",
    "ge": "{0} >= {1}",
    "gt": "{0} > {1}",
    "le": "{0} <= {1}",
    "lt": "{0} < {1}",
    "mul": "{0} * {1}",
    "nan_to_num": "finite({0}, {1}, {2}, {3})",
    "ne": "{0} != {1}",
    "neg": "-{0}",
    "pow": "{0} * {0}",  # the exponent is 2
    "reciprocal": "divide(1.0, {0})",
    "remainder": "remainder({0}, {1})",
    "round": "rounded({0})",
    "rsub": "{1} - {0}",
    "sigmoid": "sigmoid({0})",
    "sign": "sign({0})",
    "sin": "sine({0})",
    "sub": "{0} - {1}",
    "tanh": "tanh({0})",
    "where": "{1} if {0} else {2}",
}
MOST_OPERANDS = {"clamp": 3, "nan_to_num": 4, "where": 3}
CONVERSIONS = {bool: "{0} != 0", float: "float({0})", int: "integer({0})"}
FILLED = {"new_ones": 1, "new_zeros": 0, "ones_like": 1, "zeros_like": 0}
SHAPES: dict[str, Callable[..., Any]] = {
    "cat": lambda parts, dim=0: np.concatenate(parts, dim),
    "clone": placed,
    "select": lambda values, dim, place: placed(np.take(values, place, dim)),
    "slice": lambda values, dim=0, start=None, end=None: np.take(
        values, range(*slice(start, end).indices(values.shape[dim])), dim
    ),
    "split_with_sizes": lambda values, sizes, dim=0: np.split(values, np.cumsum(sizes)[:-1], dim),
    "stack": lambda parts, dim=0: np.stack(parts, dim),
    "unbind": lambda values, dim=0: [placed(np.take(values, each, dim)) for each in range(values.shape[dim])],
    "unsqueeze": np.expand_dims,
}
