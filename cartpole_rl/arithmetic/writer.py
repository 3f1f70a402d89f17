"""Writes the graph of a pure function of tensors as lines of plain arithmetic, in any language.

The graph is evaluated once on arrays of expressions instead of numbers: operations on shapes move expressions
about, and each arithmetic operation on each number writes a line. NaN, infinities, division by zero and
conversions behave as in PyTorch.

To support another operation of PyTorch, add it by its name in ATen to `SHAPES` or `FILLED`, or to
`languages.OPERATIONS`.

In Python, `Scalar` runs a function for one cart. PyTorch takes microseconds for each operation, whatever the
number of carts; Python takes a hundredth of that for a sum of two floats. Its floats have 64 bits, so results
equal those of float32 tensors up to rounding.
"""

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import Node

from cartpole_rl.arithmetic.languages import FUNCTIONS, PYTHON, Line, Operand, Python
from cartpole_rl.compilation import Trace, trace

Expressions = NDArray[np.object_]  # numbers, and names of variables
LARGEST_FLOAT = torch.finfo(torch.float32).max
CONVERTED = None, torch.bool, torch.int32, torch.int64, torch.float32, torch.float64  # others round or wrap
CONVERSIONS = {bool: "to_bool", float: "to_float", int: "to_int"}
FILLED = {"new_ones": 1, "new_zeros": 0, "ones_like": 1, "zeros_like": 0}
MOST_OPERANDS = {"clamp": 3, "nan_to_num": 4, "where": 3}
VARIABLE = re.compile(r"\bv\d+\b")


class Writer:
    """The lines of a function that is being written in `language`."""

    def __init__(self, language: Python) -> None:
        self._language = language
        self._lines: dict[str, Line] = {}  # by expression
        self._kinds: dict[str, type] = {}  # of variables

    def variables(self, pattern: str, example: torch.Tensor) -> Expressions:
        """Return an input of the shape and type of `example`: variables named "x[0]", "x[1]" by "x[{0}]"."""
        names = [pattern.format(place) for place in range(example.numel())]
        self._kinds |= dict.fromkeys(names, kind_of(example.dtype))
        return np.array(names, dtype=object).reshape(tuple(example.shape))

    def write(self, traced: Trace, inputs: Sequence[Expressions]) -> list[Expressions]:
        """Return the outputs of a graph, after writing the lines that compute them."""
        values: dict[Node, Any] = {}
        unread = iter(inputs)
        for node in traced.graph.nodes:
            if node.op == "placeholder":
                values[node] = next(unread)
            elif node.op == "get_attr":
                values[node] = np.asarray(traced.constants[node.target].numpy(), dtype=object)
            elif node.op == "output":
                return [values[each] for each in node.args[0]]
            else:
                values[node] = self._evaluate(node, values)
        raise AssertionError("a graph has an output")

    def statements(self, outputs: Iterable[Expressions]) -> list[str]:
        """Return the declarations of the variables that `outputs` need, in order."""
        needed = {each for output in outputs for each in output.reshape(-1) if isinstance(each, str)}
        kept = []
        for line in reversed(self._lines.values()):
            if line.name in needed:
                needed.update(VARIABLE.findall(line.expression))
                kept.append(self._language.declaration(line))
        return kept[::-1]

    def kind(self, value: Any) -> type:
        """Return the type of a number, or of the variable of this name."""
        return self._kinds[value] if isinstance(value, str) else type(value)

    def _evaluate(self, node: Node, values: dict[Node, Any]) -> Any:
        """Return the result of a node, after writing the lines that compute it."""
        arguments: Any = torch.fx.map_arg(node.args, values.__getitem__)
        named: Any = torch.fx.map_arg(node.kwargs, values.__getitem__)
        if node.target is operator.getitem:
            return arguments[0][arguments[1]]
        assert isinstance(node.target, OpOverload)
        name = node.target._schema.name.removeprefix("aten::")
        if name in SHAPES:
            return SHAPES[name](*arguments, **named)
        try:
            kind = kind_of(node.meta["dtype"])  # or KeyError: it has several results
            if name in FILLED:
                return np.full(node.meta["shape"], kind(FILLED[name]), dtype=object)
            return self._each(*operation_of(name, arguments, named, kind), kind)
        except KeyError:
            raise NotImplementedError(
                f"{node.target} cannot be written as plain arithmetic; add it to cartpole_rl/arithmetic/"
            ) from None

    def _each(self, operation: str, operands: Sequence[Any], kind: type) -> Expressions:
        """Write an operation on each of the broadcast `operands`; return what holds the results."""
        operands = [np.asarray(each, dtype=object) for each in operands]
        results = np.empty(np.broadcast_shapes(*(each.shape for each in operands)), dtype=object)
        for place, parts in zip(np.ndindex(results.shape), np.broadcast(*operands), strict=True):
            results[place] = self._write(operation, parts, kind)
        return results

    def _write(self, operation: str, parts: Sequence[Any], kind: type) -> Any:
        """Write a line unless it is known; return its variable, or the number if all `parts` are numbers."""
        operands = [Operand(part, self.kind(part)) for part in parts]
        if not any(isinstance(part, str) for part in parts):
            return eval(PYTHON.expression(operation, operands, kind), dict(FUNCTIONS))
        expression = self._language.expression(operation, operands, kind)
        if expression not in self._lines:
            name = f"v{len(self._lines) + 1}"
            self._lines[expression] = Line(name, kind, expression)
            self._kinds[name] = kind
        return self._lines[expression].name


def operation_of(
    name: str, arguments: Sequence[Any], named: Mapping[str, Any], kind: type
) -> tuple[str, Sequence[Any]]:
    """Return the name of an arithmetic operation and its operands, for a result of type `kind`.

    Raises KeyError if it has an option that is not known here, such as alpha.
    """
    if name == "_to_copy":
        if named.get("dtype") not in CONVERTED:
            raise KeyError(name)
        return CONVERSIONS[kind], arguments
    if named:
        raise KeyError(name)
    if name == "clamp":
        value, low, high = (*arguments, None, None)[:3]
        arguments = value, -math.inf if low is None else low, math.inf if high is None else high
    elif name == "nan_to_num":
        value, of_nan, of_inf, of_minus_inf = (*arguments, None, None, None)[:4]
        defaults = (0.0, LARGEST_FLOAT, -LARGEST_FLOAT)
        given = (of_nan, of_inf, of_minus_inf)
        arguments = value, *(b if a is None else a for a, b in zip(given, defaults, strict=True))
    elif name == "bitwise_not" and kind is bool:
        return "logical_not", arguments
    elif name == "div" and isinstance(arguments[1], int | float) and arguments[1]:
        return "div_by_number", arguments
    elif name == "pow" and isinstance(arguments[1], int | float) and arguments[1] == 2:
        return "square", arguments[:1]  # other powers are not known
    if len(arguments) > MOST_OPERANDS.get(name, 2):
        raise KeyError(name)
    return name, arguments


def kind_of(dtype: torch.dtype) -> type:
    """Return Python's type of the numbers of a tensor."""
    if dtype.is_floating_point:
        return float
    return bool if dtype is torch.bool else int


def placed(values: Any) -> Expressions:
    """Return an array of expressions; NumPy returns a single one without an array."""
    return np.asarray(values, dtype=object)


SHAPES: dict[str, Callable[..., Any]] = {
    "alias": lambda values: values,
    "cat": lambda parts, dim=0: np.concatenate(parts, dim),
    "clone": placed,
    "select": lambda values, dim, place: placed(np.take(values, place, dim)),
    "slice": lambda values, dim=0, start=None, end=None, step=1: np.take(
        values, range(*slice(start, end, step).indices(values.shape[dim])), dim
    ),
    "split": lambda values, size, dim=0: np.split(values, range(size, values.shape[dim], size), dim),
    "split_with_sizes": lambda values, sizes, dim=0: np.split(values, np.cumsum(sizes)[:-1], dim),
    "stack": lambda parts, dim=0: np.stack(parts, dim),
    "unbind": lambda values, dim=0: [placed(np.take(values, each, dim)) for each in range(values.shape[dim])],
    "unsqueeze": np.expand_dims,
}


class Scalar:
    """A pure `function` of tuples of tensors, named or plain, as arithmetic of Python's numbers.

    `examples` are arguments of the shapes and types to trace. Calls take and return the same tuples, with a
    flat sequence of numbers in place of each tensor. Whatever else `function` reads must not change.
    Raises NotImplementedError for an operation that is not known.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], *examples: tuple[Tensor, ...]) -> None:
        traced = trace(function, examples)
        self._result = traced.result
        self._compute = compiled(traced, examples)

    def __call__(self, *arguments: Sequence[Sequence[float]]) -> Any:
        """Return the function's result."""
        return self._result(self._compute(*arguments))


def plain(tensor: Tensor) -> tuple[Any, ...]:
    """Return the numbers of a tensor, for a call of a `Scalar`."""
    return tuple(tensor.reshape(-1).tolist())


def compiled(traced: Trace, examples: Sequence[tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Return the Python function that computes the outputs of a graph."""
    writer = Writer(PYTHON)
    inputs = [
        [writer.variables(f"i{row}_{part}_{{0}}", tensor) for part, tensor in enumerate(example)]
        for row, example in enumerate(examples)
    ]
    outputs = writer.write(traced, [each for example in inputs for each in example])
    names = [f"argument_{row}" for row in range(len(inputs))]
    lines = [
        *(f"({''.join(map(display, parts))}) = {name}" for name, parts in zip(names, inputs, strict=True)),
        *writer.statements(outputs),
        f"return ({''.join(map(display, outputs))})",
    ]
    namespace = dict(FUNCTIONS)
    exec("\n    ".join((f"def compute({', '.join(names)}):", *lines)), namespace)
    return namespace["compute"]


def display(values: Expressions) -> str:
    """Return a tuple display of all expressions, and a comma."""
    return f"({''.join(f'{PYTHON.text(each)}, ' for each in values.reshape(-1))}), "
