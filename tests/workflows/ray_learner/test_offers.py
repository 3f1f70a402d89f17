"""Weights that arrive from another machine reach the motor only if they are whole, finite and fitting."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from cartpole_rl.errors import CheckpointError
from cartpole_rl.workflows.ray_learner.offers import HEADER, Offer, OfferFile, pack, unpack, write_offer


@pytest.fixture
def state() -> dict[str, Tensor]:
    return {"weight": torch.randn(3, 2), "updates": torch.tensor(2**40), "bias": torch.zeros(2)}


def test_weights_arrive_to_the_bit(state: dict[str, Tensor]) -> None:
    version, arrived = unpack(Offer(pack(7, state)).bytes(), {**state, "weight": torch.zeros(3, 2)})
    assert version == 7
    assert list(arrived) == list(state)
    assert all(torch.equal(arrived[name], tensor) for name, tensor in state.items())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_refused(value: float, state: dict[str, Tensor]) -> None:
    state["weight"][1, 1] = value
    with pytest.raises(CheckpointError, match=r"version 3 .* weight is not finite"):
        unpack(pack(3, state), state)


@pytest.mark.parametrize("place", [0, HEADER.size, -1])
def test_one_wrong_byte_is_noticed(place: int, state: dict[str, Tensor]) -> None:
    packed = bytearray(pack(3, state))
    packed[place] ^= 1
    with pytest.raises(CheckpointError, match="damaged or incomplete"):
        unpack(bytes(packed), state)


def test_halves_of_two_versions_are_refused(state: dict[str, Tensor]) -> None:
    older, newer = pack(3, state), pack(4, {**state, "bias": torch.ones(2)})
    with pytest.raises(CheckpointError, match="damaged or incomplete"):
        unpack(newer[:20] + older[20:], state)


@pytest.mark.parametrize("length", [0, 5, HEADER.size, 40])
def test_a_part_is_refused(length: int, state: dict[str, Tensor]) -> None:
    with pytest.raises(CheckpointError, match=f"sent {length} bytes"):
        unpack(pack(3, state)[:length], state)


def test_another_network_is_refused(state: dict[str, Tensor]) -> None:
    with pytest.raises(CheckpointError, match="another network"):
        unpack(pack(3, state), {**state, "weight": torch.zeros(3, 3)})


def test_each_offer_is_read_once(tmp_path: Path) -> None:
    file = OfferFile(tmp_path)
    assert file.next() is None
    write_offer(tmp_path, b"first")
    assert file.next() == b"first"
    assert file.next() is None
    write_offer(tmp_path, b"second")
    assert OfferFile(tmp_path).next() == file.next() == b"second"
    file.remove()
    assert file.next() is None
