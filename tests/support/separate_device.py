"""A device for tests without a GPU: it computes, and mixes with the CPU no more than a GPU does.

Its tensors report the device "meta" and keep their values in a tensor on the CPU. ("cuda" cannot be used:
without a GPU, PyTorch computes no gradients there.) An operation on them and a tensor on the CPU raises
RuntimeError, except where CUDA allows it: copies, numbers [] and indices.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

DEVICE, CPU = torch.device("meta"), torch.device("cpu")
# CUDA takes operands on the CPU here
CAN_MIX = ("_to_copy", "copy_", "index", "index_put_", "_index_put_impl_")


class SeparateTensor(Tensor):
    """A tensor on the separate device."""

    values: Tensor  # on the CPU

    @staticmethod
    def __new__(cls, values: Tensor) -> "SeparateTensor":
        """Make a tensor with `values`."""
        layout = {
            "strides": values.stride(),
            "storage_offset": values.storage_offset(),
            "dtype": values.dtype,
        }
        tensor = Tensor._make_wrapper_subclass(cls, values.size(), device=DEVICE, **layout)
        tensor.values = values
        return tensor

    @classmethod
    def __torch_dispatch__(cls, *arguments: Any, **named: Any) -> Any:
        """Raise RuntimeError: only `Operations` can compute with it."""
        raise RuntimeError("an operation on the separate device outside of its context")


class Operations(TorchDispatchMode):
    """The operations of the separate device, which are those of the CPU on the values of its tensors."""

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run an operation; raise RuntimeError if it mixes devices."""
        kwargs = kwargs or {}
        operands = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        owners = {id(each.values): each for each in operands if isinstance(each, SeparateTensor)}
        if any(each.device == DEVICE and not isinstance(each, SeparateTensor) for each in operands):
            raise RuntimeError(f"{function} of a tensor of PyTorch's own device meta, which has no values")
        if owners:
            check_devices(function.overloadpacket.__name__, operands)
        target = kwargs.get("device")
        on_cpu = kwargs if target is None else {**kwargs, "device": CPU}
        result = function(*values_of(args), **values_of(on_cpu))
        if target not in (None, DEVICE) or not (owners or target):
            return result

        def placed(value: Tensor) -> Tensor:  # an operation in place returns its operand
            return owners[id(value)] if id(value) in owners else SeparateTensor(value)

        return tree_map_only(Tensor, placed, result)


class Calls(TorchFunctionMode):
    """The calls that PyTorch would not pass on to `Operations` for "meta" or for subclasses of Tensor."""

    def __torch_function__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call a function."""
        kwargs = kwargs or {}
        if function is Tensor.tolist:
            return args[0].cpu().tolist()
        if function is Tensor.new_tensor:
            return torch.tensor(args[1], **{"dtype": args[0].dtype, **kwargs}).to(args[0].device)
        if function in (torch.tensor, torch.as_tensor):
            target = kwargs.pop("device", None)
            made = function(*args, **kwargs)
            return made if target is None else made.to(target)
        return function(*args, **kwargs)


class SeparateGenerator(torch.Generator):
    """A generator of the separate device, with the numbers of one on the CPU."""

    def __new__(cls, device: torch.device | str = CPU) -> Any:
        """Make one; on another device than the separate one, a generator of PyTorch."""
        return super().__new__(cls) if torch.device(device) == DEVICE else torch._C.Generator(device)

    @property
    def device(self) -> torch.device:
        """The separate device."""
        return DEVICE


@contextmanager
def separate_device() -> Iterator[None]:
    """Let `device="meta"` be the separate device."""
    fused = patch("torch.optim.optimizer._get_fused_kernels_supported_devices", lambda: [DEVICE.type])
    with fused, patch("torch.Generator", SeparateGenerator), Calls(), Operations():
        yield


def check_devices(name: str, operands: list[Tensor]) -> None:
    """Raise RuntimeError if the operation `name` has an operand on the CPU that CUDA would refuse."""
    for each in operands:
        if each.ndim and each.device == CPU and name not in CAN_MIX:
            raise RuntimeError(f"{name} of tensors on two devices: one of shape {each.shape} is on the CPU")


def values_of(value: Any) -> Any:
    """Return `value` with the values, on the CPU, of all its tensors on the separate device."""
    return tree_map_only(SeparateTensor, lambda tensor: tensor.values, value)
