"""Pure functions of tensors as flat graphs: traced once, for the shapes of the first call.

`torch.compile` would also check every Python object that the function reads, in every call, which takes
longer than the arithmetic of a thousand carts. If only the tensors change between calls, there is nothing to
check.

`standalone_compile` is a private function of PyTorch: no public one compiles a traced graph without
those checks. If it is removed, replace it here with `torch.compile` and the `guard_filter_fn`
`torch.compiler.skip_all_guards_unsafe`.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from types import BuiltinFunctionType
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch._inductor import standalone_compile
from torch._ops import OpOverload
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx

OPTIONS = {"cpp.enable_floating_point_contract_flag": "fast"}  # fused multiply-add on the CPU; Triton has it

Arguments = Sequence[tuple[Tensor, ...]]
Result = TypeVar("Result", bound=tuple)


class Trace(NamedTuple):
    """A function of tuples of tensors as a graph of single tensors."""

    graph: GraphModule
    result: Callable[[Iterable[Any]], Any]  # builds the function's result from its parts
    types: list[torch.dtype]  # of the parts


def trace(
    function: Callable[..., tuple[Tensor, ...]],
    arguments: Arguments,
    store: Callable[[Tensor], Tensor] = lambda part: part,
) -> Trace:
    """Return the graph of `function`, which stores each part of the result as `store` returns it."""
    kinds: list[Any] = []

    def flat(*tensors: Tensor) -> list[Tensor]:
        rest = iter(tensors)
        value = function(*(rebuild(each)(islice(rest, len(each))) for each in arguments))
        kinds.extend((rebuild(value), [part.dtype for part in value]))
        return [store(part) for part in value]

    graph = make_fx(flat)(*map(copied, chain.from_iterable(arguments)))
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return Trace(graph, *kinds)


def bound(graph: GraphModule) -> GraphModule:
    """Return `graph` with PyTorch's own functions for its operators, which are called in half the time.

    Both are made of the same schemas, so their arguments are the same.
    """
    for node in graph.graph.nodes:
        if isinstance(node.target, OpOverload):
            function = getattr(torch, node.target._schema.name.removeprefix("aten::"), None)
            if isinstance(function, BuiltinFunctionType):
                node.target = function
    graph.recompile()
    return graph


class Traced(Generic[Result]):
    """A `function` that takes tuples of tensors, named or plain, and returns another, as a graph.

    Its graph is that of the first call, whose shapes, types and devices all later calls must have; whatever
    else `function` reads must not change. No gradient flows through it, though the function may compute one.
    Without modules and tensordicts, a small network takes a third of the time.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function = function
        self._call: Callable[..., Any] | None = None
        self._result: Callable[..., Result]

    @torch.no_grad()
    def __call__(self, *arguments: tuple[Tensor, ...]) -> Result:
        """Return the function's result."""
        if self._call is None:
            traced = trace(self._function, arguments)
            self._call, self._result = bound(traced.graph).forward, traced.result
        return self._result(self._call(*chain.from_iterable(arguments)))


class Compiled(Generic[Result]):
    """A `Traced` function whose graph goes straight to TorchInductor: one compiled call.

    It needs a C++ compiler, and Triton for a GPU. TorchInductor caches the code on disk, also for other
    processes.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function = function
        self._call: Callable[..., Any] | None = None
        self._result: Callable[..., Result]
        self._types: list[torch.dtype] = []

    @torch.no_grad()
    def __call__(self, *arguments: tuple[Tensor, ...]) -> Result:
        """Return the function's result."""
        tensors = [tensor.contiguous() for tensor in chain.from_iterable(arguments)]
        if self._call is None:
            self._call = self._compile(arguments, tensors)
        values = self._call(*tensors)
        return self._result(map(Tensor.view, values, self._types))

    def _compile(self, arguments: Arguments, tensors: Sequence[Tensor]) -> Callable[..., Any]:
        traced = trace(self._function, arguments, as_byte)
        self._result, self._types = traced.result, traced.types
        return standalone_compile(
            traced.graph,
            list(tensors),
            dynamic_shapes="from_example_inputs",
            options={"config_patches": OPTIONS},
        )


def copied(tensor: Tensor) -> Tensor:
    """Return a copy: make_fx takes a tensor that is given twice for one argument."""
    return tensor.detach().clone().requires_grad_(tensor.requires_grad)


def rebuild(example: tuple[Any, ...]) -> Callable[[Iterable[Any]], Any]:
    """Return a constructor of tuples of the type of `example` from an iterable."""
    return getattr(type(example), "_make", tuple)


def as_byte(part: Tensor) -> Tensor:
    """Return 1 or 0 for each flag, other numbers unchanged.

    Compiled code stores bytes eight at a time, but booleans one by one.
    """
    return torch.where(part, 1.0, 0.0).to(torch.uint8) if part.dtype is torch.bool else part
