"""Pure functions of tensors as plain Python arithmetic, for one cart.

PyTorch takes microseconds for each operation, whatever the number of carts; Python takes a hundredth of that
for a sum of two floats. A function is traced as in `compilation.py`, and `arithmetic/` writes its graph as
lines of Python. Its floats have 64 bits, so results equal those of float32 tensors up to rounding.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from cartpole_rl.arithmetic.languages import FUNCTIONS, PYTHON
from cartpole_rl.arithmetic.writer import Expressions, Writer
from cartpole_rl.compilation import trace


class Scalar:
    """A pure `function` of tuples of tensors, named or plain, as arithmetic of Python's numbers.

    `examples` are arguments of the shapes and types to trace. Calls take and return the same tuples, with a
    flat sequence of numbers in place of each tensor. Whatever else `function` reads must not change.
    Raises NotImplementedError for an operation that is not known.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]], *examples: tuple[Tensor, ...]) -> None:
        with torch.no_grad():
            traced = trace(function, examples, mode="fake")
        self._result = traced.result
        self._compute = compiled(traced.graph, examples)

    def __call__(self, *arguments: Sequence[Sequence[float]]) -> Any:
        """Return the function's result."""
        return self._result(self._compute(*arguments))


def plain(tensor: Tensor) -> tuple[Any, ...]:
    """Return the numbers of a tensor, for a call of a `Scalar`."""
    return tuple(tensor.reshape(-1).tolist())


def compiled(graph: torch.fx.GraphModule, examples: Sequence[tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Return the Python function that computes the outputs of `graph`."""
    writer = Writer(PYTHON)
    inputs = [
        [writer.variables(f"i{row}_{part}_{{0}}", tensor) for part, tensor in enumerate(example)]
        for row, example in enumerate(examples)
    ]
    outputs = writer.write(graph, [each for example in inputs for each in example])
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
