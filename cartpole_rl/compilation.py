"""Compiles a pure function of tensors for the shapes that it is first called with.

The function is traced to a flat graph, which TorchInductor gets as it is. `torch.compile` would also guard
every Python object that the function reads, in every call, and that takes longer than the arithmetic of a
thousand carts; where nothing but the tensors changes between two calls, there is nothing to guard.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor
from torch._inductor import standalone_compile
from torch.fx.experimental.proxy_tensor import make_fx

OPTIONS = {"cpp.enable_floating_point_contract_flag": "fast"}  # a product and a sum may be rounded as one

Result = TypeVar("Result", bound=tuple)


class Compiled(Generic[Result]):
    """`function` of tuples of tensors, named or plain, which returns another, compiled in its first call.

    Shapes, types and devices have to stay as they are in that call, and so has all that `function` reads
    beside its arguments. It needs a C++ compiler; what was compiled is kept on disk by TorchInductor, where
    the next process finds it. No gradient flows through it; the function may well compute one.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function = function
        self._call: Callable[..., Any] | None = None
        self._result: Callable[..., Result]
        self._types: list[torch.dtype] = []

    @torch.no_grad()
    def __call__(self, *arguments: tuple[Tensor, ...]) -> Result:
        """The function's value."""
        tensors = [tensor.contiguous() for tensor in chain.from_iterable(arguments)]
        if self._call is None:
            self._call = self._compile(arguments, tensors)
        values = self._call(*tensors)
        return self._result(map(Tensor.view, values, self._types))

    def _compile(
        self, arguments: Sequence[tuple[Tensor, ...]], tensors: Sequence[Tensor]
    ) -> Callable[..., Any]:
        def flat(*tensors: Tensor) -> list[Tensor]:
            rest = iter(tensors)
            value = self._function(*(rebuild(each)(islice(rest, len(each))) for each in arguments))
            self._result, self._types = rebuild(value), [part.dtype for part in value]
            return [as_byte(part) if part.dtype is torch.bool else part for part in value]

        return standalone_compile(
            make_fx(flat)(*tensors),
            list(tensors),
            dynamic_shapes="from_example_inputs",
            options={"config_patches": OPTIONS},
        )


def rebuild(example: tuple[Tensor, ...]) -> Callable[[Iterable[Tensor]], Any]:
    """What makes a tuple like `example` of as many tensors."""
    return getattr(type(example), "_make", tuple)


def as_byte(flags: Tensor) -> Tensor:
    """1 or 0 for each flag: compiled code stores bytes eight at a time, but booleans one by one."""
    return torch.where(flags, 1.0, 0.0).to(torch.uint8)
