"""Pure functions of tensors as flat graphs: traced once, for the shapes of the first call.

`torch.compile` would also check every Python object that the function reads, in every call, which takes
longer than the arithmetic of a thousand carts. If only the tensors change between calls, there is nothing to
check.

`standalone_compile` is a private function of PyTorch: no public one compiles a traced graph without
those checks. If it is removed, replace it here with `torch.compile` and the `guard_filter_fn`
`torch.compiler.skip_all_guards_unsafe`.
"""

import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._inductor import standalone_compile
from torch._ops import OpOverload
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx

from cartpole_rl.errors import ConfigError

OPTIONS = {"cpp.enable_floating_point_contract_flag": "fast"}  # fused multiply-add on the CPU; Triton has it

BRANCHES = "data-dependent", "_local_scalar_dense"  # in PyTorch's errors about `if` of a tensor
TORCH = Path(torch.__file__).parent

Arguments = Sequence[tuple[Tensor, ...]]
Columns = tuple[Tensor, ...]  # of a batch of transitions
IMPORTANCE_WEIGHT: NestedKey = "priority_weight"
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
    mode: Literal["real", "fake"] = "real",
) -> Trace:
    """Return the graph of `function`, which stores each part of the result as `store` returns it.

    The `mode` "fake" computes shapes alone, and takes two thirds of the time.
    """
    kinds: list[Any] = []

    def flat(*tensors: Tensor) -> list[Tensor]:
        rest = iter(tensors)
        value = function(*(rebuild(each)(islice(rest, len(each))) for each in arguments))
        kinds.extend((rebuild(value), [part.dtype for part in value]))
        return [store(part) for part in value]

    inputs = [*map(copied, chain.from_iterable(arguments))]
    try:
        graph = make_fx(flat, tracing_mode=mode, _allow_non_fake_inputs=True)(*inputs)
    except RuntimeError as error:
        if not any(sign in str(error) for sign in BRANCHES):
            raise
        calls = traceback.extract_tb(error.__traceback__)
        own = [call for call in calls if TORCH not in Path(call.filename).parents]
        raise ConfigError(
            f"{own[-1].filename}, line {own[-1].lineno}: a formula cannot branch on a number of the carts; "
            "use torch.where(condition, one, other)"
        ) from None
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

    It is traced in the first call, whose shapes, types and devices all later calls must have; whatever else
    `function` reads must not change. No gradient flows through it, though the function may compute one.
    Without modules and tensordicts, a small network takes a third of the time.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        self._function = function
        self._call: Callable[..., Any] | None = None
        self._result: Callable[[Any], Result]

    @torch.no_grad()
    def __call__(self, *arguments: tuple[Tensor, ...]) -> Result:
        """Return the function's result."""
        if self._call is None:
            self._call, self._result = self._make(arguments)
        return self._result(self._call(*chain.from_iterable(arguments)))

    def _make(self, arguments: Arguments) -> tuple[Callable[..., Any], Callable[[Any], Result]]:
        """Return a function of single tensors, and what builds the result from its values."""
        traced = trace(self._function, arguments)
        return bound(traced.graph).forward, traced.result


class Compiled(Traced[Result]):
    """A `Traced` function whose graph goes straight to TorchInductor: one compiled call.

    It needs a C++ compiler, and Triton for a GPU. TorchInductor caches the code on disk, also for other
    processes.
    """

    def _make(self, arguments: Arguments) -> tuple[Callable[..., Any], Callable[[Any], Result]]:
        traced = trace(self._function, arguments, as_byte)
        compiled = standalone_compile(
            traced.graph,
            [tensor.contiguous() for tensor in chain.from_iterable(arguments)],
            dynamic_shapes="from_example_inputs",
            options={"config_patches": OPTIONS},
        )

        def call(*tensors: Tensor) -> Any:
            return compiled(*[tensor.contiguous() for tensor in tensors])

        return call, lambda values: traced.result(map(Tensor.view, values, traced.types))


class LossGradient:
    """The clipped gradient of a TorchRL `loss` as one call, optionally `compiled`.

    It equals `loss.backward()` followed by clipping to `max_norm`. Compiled, it has no module look-ups, no
    guards and few kernels (scripts/bench/shortcuts.py). `weights` are the trainable weights. The loss reads
    `keys` of a batch, and "priority_weight" if a prioritized buffer added it.
    """

    def __init__(
        self, loss: nn.Module, keys: Sequence[NestedKey], max_norm: float, compiled: bool = False
    ) -> None:
        self.loss, self.keys, self.max_norm = loss, (*keys, IMPORTANCE_WEIGHT), max_norm
        state = dict(TensorDict.from_module(loss).items(True, True))
        self._trainable = {name: weight for name, weight in state.items() if weight.requires_grad}
        self._fixed = {name: weight for name, weight in state.items() if not weight.requires_grad}
        self.weights: list[Tensor] = list(self._trainable.values())
        self._gradient = Compiled(self._compute) if compiled else self._compute

    def columns(self, transitions: TensorDictBase) -> Columns:
        """Return the columns that a call takes."""
        keys = self.keys if IMPORTANCE_WEIGHT in transitions else self.keys[:-1]
        return tuple(transitions.get(key) for key in keys)

    def __call__(self, columns: Columns) -> tuple[Tensor, Tensor, Tensor]:
        """Set the gradient of each weight; return loss [], unclipped norm [] and `td_error` [B, 1]."""
        fixed = tuple(self._fixed.values())
        loss, norm, errors, *gradients = self._gradient(tuple(self.weights), fixed, columns)
        for weight, gradient in zip(self.weights, gradients, strict=True):
            weight.grad = gradient
        return loss, norm, errors

    def _compute(self, trainable: Columns, fixed: Columns, columns: Columns) -> Columns:
        """Return loss, norm, errors and gradients as a pure function of weights and batch."""
        leaves = [weight.detach().requires_grad_() for weight in trainable]
        state = TensorDict(dict(zip((*self._trainable, *self._fixed), (*leaves, *fixed), strict=True)))
        batch = TensorDict(dict(zip(self.keys, columns, strict=False)), batch_size=columns[0].shape[:1])
        with acting_with(state, self.loss), torch.enable_grad():
            loss = self.loss(batch)["loss"]
            gradients = torch.autograd.grad(loss, leaves)
        norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
        share = (self.max_norm / norm).clamp(max=1)
        return loss.detach(), norm, batch["td_error"], *(share * each for each in gradients)


@contextmanager
def acting_with(weights: TensorDictBase, module: nn.Module) -> Iterator[None]:
    """Let `module` act with `weights`; at the end it has its own again.

    With `to_module` alone, tensordict 0.14 raises a RuntimeError in place of a KeyboardInterrupt. With the
    module's state preserved, tensors would become new parameters, constants to a tracer.
    """
    scope = weights.to_module(module, preserve_module_state=False)
    scope.__enter__()
    try:
        yield
    finally:
        scope.__exit__(None, None, None)


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
