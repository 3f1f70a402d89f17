"""Pure functions of tensors as flat graphs: traced once, for the shapes of the first call.

`torch.compile` would also check every Python object that the function reads, in every call, which takes
longer than the arithmetic of a thousand carts. If only the tensors change between calls, there is nothing to
check.

`standalone_compile` is a private function of PyTorch: no public one compiles a traced graph without
those checks. If it is removed, replace it here with `torch.compile` and the `guard_filter_fn`
`torch.compiler.skip_all_guards_unsafe`.
"""

import operator
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._inductor import standalone_compile
from torch._ops import OpOverload
from torch.fx import Graph, GraphModule
from torch.fx.node import map_aggregate
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.weak import WeakTensorKeyDictionary

from cartpole_rl.errors import ConfigError

OPTIONS = {"cpp.enable_floating_point_contract_flag": "fast"}  # fused multiply-add on the CPU; Triton has it

READS = Tensor.numpy, Tensor.tolist, Tensor.__array__  # are no operations
REPLACED = {  # in a graph: what follows torch.tensor(...) may change it, and gradients are over
    torch.ops.aten.lift_fresh.default: torch.ops.aten.clone.default,
    torch.ops.aten.detach.default: torch.ops.aten.alias.default,
}
TORCH = Path(torch.__file__).parent

Arguments = Sequence[tuple[Tensor, ...]]
Columns = tuple[Tensor, ...]  # of a batch of transitions
IMPORTANCE_WEIGHT: NestedKey = "priority_weight"
Result = TypeVar("Result", bound=tuple)


class Trace(NamedTuple):
    """A function of tuples of tensors as a graph of single tensors."""

    graph: Graph
    constants: dict[str, Tensor]  # by the targets of the graph's get_attr
    result: Callable[[Iterable[Any]], Any]  # builds the function's result from its parts
    types: list[torch.dtype]  # of the parts


class Recorder(TorchDispatchMode):
    """Writes the operations that are computed meanwhile into a graph.

    It is the graph of PyTorch's `make_fx`, in a fifth of its time or less.
    """

    def __init__(self, inputs: Iterable[Tensor]) -> None:
        super().__init__()
        self.graph = Graph()
        self.constants: dict[str, Tensor] = {}
        self._nodes = WeakTensorKeyDictionary()
        for place, tensor in enumerate(inputs):
            self._nodes[tensor] = self.graph.placeholder(f"input_{place}")

    def node(self, value: Any) -> Any:
        """Return the node of a tensor, a constant if no operation gave it, and other values unchanged."""
        if not isinstance(value, Tensor):
            return value
        if value not in self._nodes:
            name = f"constant_{len(self.constants)}"
            self.constants[name] = value
            self._nodes[value] = self.graph.get_attr(name)
            self._nodes[value].meta["is_constant"] = True
        return self._nodes[value]

    def check(self, value: Any) -> None:
        """Raise ConfigError for a tensor whose numbers are not constant."""
        if not isinstance(value, Tensor) or "is_constant" in self.node(value).meta:
            return
        files = [(Path(call.filename), call.lineno) for call in traceback.extract_stack()]
        own = [call for call in files if TORCH not in call[0].parents and call[0] != Path(__file__)]
        raise ConfigError(
            f"{own[-1][0]}, line {own[-1][1]}: a formula cannot read a number of the carts, as `if`, "
            "float() and NumPy do; use functions of torch, as torch.where(condition, one, other)"
        )

    def __torch_dispatch__(
        self, operation: Any, types: Any, arguments: Any = (), named: dict[str, Any] | None = None
    ) -> Any:
        """Compute an operation and write it. Raises ConfigError for one that reads a number."""
        operation, named = REPLACED.get(operation, operation), named or {}
        if torch.Tag.data_dependent_output in operation.tags:
            for value in arguments:
                self.check(value)
            return operation(*arguments, **named)
        result = operation(*arguments, **named)
        self._write(operation, map_aggregate((arguments, named), self.node), result)
        return result

    def _write(self, target: Any, inputs: Any, result: Any) -> None:
        """Write the call that gave a tensor or several; constants give constants."""
        node = self.graph.call_function(target, *inputs)
        if node.all_input_nodes and all("is_constant" in each.meta for each in node.all_input_nodes):
            node.meta["is_constant"] = True
        if isinstance(result, Tensor):
            node.meta["dtype"], node.meta["shape"] = result.dtype, tuple(result.shape)
            self._nodes[result] = node
        elif isinstance(result, tuple | list):
            for place, part in enumerate(result):
                self._write(operator.getitem, ((node, place), {}), part)


class Reads(TorchFunctionMode):
    """Calls `check` with each tensor whose numbers are read by Python or NumPy, not by an operation."""

    def __init__(self, check: Callable[[Any], None]) -> None:
        super().__init__()
        self._check = check

    def __torch_function__(
        self, function: Any, types: Any, arguments: Any = (), named: dict[str, Any] | None = None
    ) -> Any:
        """Call a function of PyTorch."""
        if function in READS:
            self._check(arguments[0])
        return function(*arguments, **(named or {}))


def trace(
    function: Callable[..., tuple[Tensor, ...]],
    arguments: Arguments,
    store: Callable[[Tensor], Tensor] = lambda part: part,
) -> Trace:
    """Return the graph of `function`, which stores each part of the result as `store` returns it.

    Raises ConfigError for a function that reads a number of a tensor, as a branch does.
    """
    inputs = [*map(copied, chain.from_iterable(arguments))]
    recorder, rest = Recorder(inputs), iter(inputs)
    with torch.inference_mode(False), torch.no_grad(), Reads(recorder.check), recorder:
        value = function(*(rebuild(each)(islice(rest, len(each))) for each in arguments))
        parts = [store(part) for part in value]
    graph = recorder.graph
    graph.output([*map(recorder.node, parts)])
    graph.eliminate_dead_code()
    return Trace(graph, recorder.constants, rebuild(value), [part.dtype for part in value])


def bound(graph: Graph) -> Graph:
    """Return `graph` with PyTorch's own functions for its operators, which are called in half the time.

    Both are made of the same schemas, so their arguments are the same.
    """
    for node in graph.nodes:
        if isinstance(node.target, OpOverload):
            function = getattr(torch, node.target._schema.name.removeprefix("aten::"), None)
            if isinstance(function, BuiltinFunctionType):
                node.target = function
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
        return GraphModule(traced.constants, bound(traced.graph)).forward, traced.result


class Compiled(Traced[Result]):
    """A `Traced` function whose graph goes straight to TorchInductor: one compiled call.

    It needs a C++ compiler, and Triton for a GPU. TorchInductor caches the code on disk, also for other
    processes.
    """

    def _make(self, arguments: Arguments) -> tuple[Callable[..., Any], Callable[[Any], Result]]:
        traced = trace(self._function, arguments, as_byte)
        compiled = standalone_compile(
            GraphModule(traced.constants, traced.graph),
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
    """Return a copy, as a tensor that is given twice is two inputs."""
    return tensor.detach().clone().requires_grad_(tensor.requires_grad)


def rebuild(example: tuple[Any, ...]) -> Callable[[Iterable[Any]], Any]:
    """Return a constructor of tuples of the type of `example` from an iterable."""
    return getattr(type(example), "_make", tuple)


def as_byte(part: Tensor) -> Tensor:
    """Return 1 or 0 for each flag, other numbers unchanged.

    Compiled code stores bytes eight at a time, but booleans one by one.
    """
    return torch.where(part, 1.0, 0.0).to(torch.uint8) if part.dtype is torch.bool else part
