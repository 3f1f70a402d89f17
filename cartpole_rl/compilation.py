"""Compilation of a pure function of tensors for the shapes of its first call.

The function is traced to a flat graph that goes straight to TorchInductor. `torch.compile` would also check
every Python object that the function reads, in every call, which takes longer than the arithmetic of a
thousand carts. If only the tensors change between calls, there is nothing to check.

`standalone_compile` is a private function of PyTorch: no public one compiles a traced graph without
those checks. If it is removed, replace it here with `torch.compile` and the `guard_filter_fn`
`torch.compiler.skip_all_guards_unsafe`.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor
from torch._inductor import standalone_compile
from torch.fx.experimental.proxy_tensor import make_fx

OPTIONS = {"cpp.enable_floating_point_contract_flag": "fast"}  # fused multiply-add on the CPU; Triton has it

Result = TypeVar("Result", bound=tuple)


class Compiled(Generic[Result]):
    """A compiled `function` that takes tuples of tensors, named or plain, and returns another.

    It is compiled in its first call, whose shapes, types and devices all later calls must have; whatever else
    `function` reads must not change. It needs a C++ compiler, and Triton for a GPU. TorchInductor caches the
    code on disk, also for other processes. No gradient flows through it, though the function may compute one.
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
    """Return a constructor of tuples of the type of `example` from an iterable of tensors."""
    return getattr(type(example), "_make", tuple)


def as_byte(flags: Tensor) -> Tensor:
    """Return 1 or 0 for each flag: compiled code stores bytes eight at a time, but booleans one by one."""
    return torch.where(flags, 1.0, 0.0).to(torch.uint8)
