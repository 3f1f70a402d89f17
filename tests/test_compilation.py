"""A compiled or traced function gives the results and the types of the plain one."""

import shutil
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from cartpole_rl.arithmetic.writer import Scalar
from cartpole_rl.compilation import Compiled, Traced, acting_with, as_byte
from cartpole_rl.errors import ConfigError
from cartpole_rl.exits import Terminated

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


@pytest.mark.parametrize("kind", [Compiled, Traced])
def test_it_computes_the_same_in_every_call(kind: type[Compiled[Moved]] | type[Traced[Moved]]) -> None:
    compiled = kind(move)
    for seed in range(3):
        result, expected = compiled(*arguments(seed)), move(*arguments(seed))
        assert isinstance(result, Moved)
        for value, right in zip(result, expected, strict=True):
            assert value.dtype == right.dtype
            torch.testing.assert_close(value, right)


@pytest.mark.parametrize("kind", [Compiled, Traced, Scalar])
@pytest.mark.parametrize(
    "is_fast",
    [
        lambda speed: (speed > 0.3).any(),
        lambda speed: speed.tolist()[0] > 0.3,
        lambda speed: max(np.abs(speed)),
    ],
    ids=["branch", "list", "NumPy"],
)
def test_a_number_that_is_read_is_refused_by_its_line(kind: Any, is_fast: Callable[[Tensor], Any]) -> None:
    def braked(speed: tuple[Tensor]) -> tuple[Tensor]:
        return (-speed[0] if is_fast(speed[0]) else speed[0],)

    with pytest.raises(ConfigError, match=r"test_compilation\.py, line \d+: a formula cannot read a number"):
        kind(braked, (torch.rand(7),)) if kind is Scalar else kind(braked)((torch.rand(7),))


@pytest.mark.parametrize("kind", [Compiled, Traced])
def test_a_constant_is_kept_and_its_number_may_be_read(kind: type[Compiled] | type[Traced]) -> None:
    limits = torch.tensor([1.0, 2.0])

    def limited(speed: tuple[Tensor]) -> tuple[Tensor]:
        most = limits.sum() if limits[1] * 2 > 3 else limits[0]
        return (speed[0].clamp(max=most.item()) + torch.tensor(1.0).add_(speed[0].min()),)

    compiled = kind(limited)
    for _ in range(2):
        assert compiled((torch.tensor([0.5, 9.0]),))[0].tolist() == [2.0, 4.5]


def test_no_gradient_flows_through_it() -> None:
    state, steps = arguments(0)
    result = Compiled(move)(State(state.place.requires_grad_(), state.speed), steps)
    assert not result.state.requires_grad


@pytest.mark.parametrize("kind", [Compiled, Traced])
def test_one_tensor_may_be_two_arguments_of_the_first_call(kind: type[Compiled] | type[Traced]) -> None:
    def difference(pair: tuple[torch.Tensor, torch.Tensor]) -> tuple[torch.Tensor]:
        return (pair[0] - pair[1],)

    compiled, first = kind(difference), torch.ones(3)
    assert compiled((first, first))[0].tolist() == [0, 0, 0]
    assert compiled((3 * first, first))[0].tolist() == [2, 2, 2]


def test_flags_become_bytes() -> None:
    flags = torch.tensor([True, False])
    assert torch.equal(as_byte(flags), torch.tensor([1, 0], dtype=torch.uint8))
    assert torch.equal(as_byte(flags).view(torch.bool), flags)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), Terminated(15), ValueError("not finite")])
def test_what_ends_a_module_with_other_weights_comes_out_and_leaves_it_with_its_own(
    error: BaseException,
) -> None:
    module = torch.nn.Linear(2, 1)
    own = dict(module.named_parameters())
    weights = TensorDict.from_module(module).data.clone().zero_()

    def act() -> None:
        with acting_with(weights, module):
            assert module(torch.ones(2)).item() == 0
            raise error

    with pytest.raises(type(error)) as raised:
        act()
    assert raised.value is error
    assert all(value is own[name] for name, value in module.named_parameters())
