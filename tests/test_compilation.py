"""A compiled function gives the results and the types of the plain one."""

import shutil
from typing import NamedTuple

import pytest
import torch

from cartpole_rl.compilation import Compiled, as_byte

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed: apt install g++")


class State(NamedTuple):
    """Two named tensors."""

    place: torch.Tensor
    speed: torch.Tensor


class Moved(NamedTuple):
    """Results of three types."""

    state: torch.Tensor
    far: torch.Tensor
    steps: torch.Tensor


def move(state: State, steps: tuple[torch.Tensor]) -> Moved:
    place = state.place + state.speed * steps[0]
    return Moved(torch.stack((place, state.speed)), place > 2, steps[0] + 1)


def arguments(seed: int) -> tuple[State, tuple[torch.Tensor]]:
    torch.manual_seed(seed)
    return State(torch.rand(7, dtype=torch.float64), torch.rand(7, dtype=torch.float64)), (torch.arange(7),)


def test_it_computes_the_same_in_every_call() -> None:
    compiled = Compiled(move)
    for seed in range(3):
        result, expected = compiled(*arguments(seed)), move(*arguments(seed))
        assert isinstance(result, Moved)
        for value, right in zip(result, expected, strict=True):
            assert value.dtype == right.dtype
            torch.testing.assert_close(value, right)


def test_no_gradient_flows_through_it() -> None:
    state, steps = arguments(0)
    result = Compiled(move)(State(state.place.requires_grad_(), state.speed), steps)
    assert not result.state.requires_grad


def test_flags_become_bytes() -> None:
    flags = torch.tensor([True, False])
    assert torch.equal(as_byte(flags), torch.tensor([1, 0], dtype=torch.uint8))
    assert torch.equal(as_byte(flags).view(torch.bool), flags)
