"""Weights on their way to the cart: one tensor of bytes, and the file in which the cart finds them.

The bytes are version, checksum and the tensors of a state dict in its order. All of them travel in one
tensor, so weights of two versions cannot be mixed.
"""

import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from cartpole_rl.errors import CheckpointError
from cartpole_rl.files import replacing
from cartpole_rl.learning.checkpoints import check_finite
from cartpole_rl.run_files import CHECKPOINTS

OFFER = "offer.bin"  # in CHECKPOINTS: the newest weights that arrived, not checked yet
HEADER = struct.Struct("<qI")  # version, CRC-32 of the version and of the bytes that follow

State = Mapping[str, Tensor]


class Offer(nn.Module):
    """A module whose only weights are the bytes of an offer, for TorchRL's weight synchronization."""

    packed: Tensor  # [B] uint8

    def __init__(self, packed: bytes) -> None:
        super().__init__()
        self.register_buffer("packed", torch.zeros(len(packed), dtype=torch.uint8))
        self.fill(packed)

    def fill(self, packed: bytes) -> None:
        """Replace the bytes by others of the same number."""
        self.packed.copy_(torch.frombuffer(bytearray(packed), dtype=torch.uint8))

    def bytes(self) -> bytes:
        """Return the bytes."""
        return self.packed.numpy().tobytes()


def pack(version: int, state: State) -> bytes:
    """Return the bytes of `state`."""
    content = b"".join(tensor.detach().cpu().contiguous().numpy().tobytes() for tensor in state.values())
    return HEADER.pack(version, _checksum(version, content)) + content


def unpack(packed: bytes, expected: State) -> tuple[int, dict[str, Tensor]]:
    """Return version and state dict of an offer; `expected` has its names, shapes and types.

    Raises CheckpointError if the bytes are not complete, are those of another network, or hold a number that
    is not finite.
    """
    size = sum(tensor.numel() * tensor.element_size() for tensor in expected.values())
    if len(packed) != HEADER.size + size:
        raise CheckpointError(
            f"the learner sent {len(packed)} bytes of weights, and this agent has {HEADER.size + size}: "
            "the learner has another network; the earlier weights are kept"
        )
    version, checksum = HEADER.unpack_from(packed)
    content = bytearray(packed[HEADER.size :])
    if checksum != _checksum(version, content):
        raise CheckpointError("weights arrived damaged or incomplete; the earlier weights are kept")
    state, offset = {}, 0
    for name, tensor in expected.items():
        flat = torch.frombuffer(content, dtype=tensor.dtype, count=tensor.numel(), offset=offset)
        state[name] = flat.reshape(tensor.shape).clone()
        offset += tensor.numel() * tensor.element_size()
    check_finite(state, f"version {version} of the learner's weights is refused")
    return version, state


def write_offer(folder: Path, packed: bytes) -> None:
    """Write an offer that arrived into the run folder `folder`, atomically."""
    with replacing(folder / CHECKPOINTS / OFFER) as beside:
        beside.write_bytes(packed)


class OfferFile:
    """The offers that arrive in a run folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / CHECKPOINTS / OFFER
        self._read: os.stat_result | None = None  # of the offer that was read last

    def next(self) -> bytes | None:
        """Return the offer that arrived since the last call; None without one."""
        try:
            with self.path.open("rb") as file:
                found = os.fstat(file.fileno())
                if self._read is not None and _identity(found) == _identity(self._read):
                    return None
                self._read = found
                return file.read()
        except FileNotFoundError:
            return None

    def remove(self) -> None:
        """Remove the file, at the end of a run."""
        self.path.unlink(missing_ok=True)


def _identity(found: os.stat_result) -> tuple[int, int]:
    return found.st_ino, found.st_mtime_ns


def _checksum(version: int, content: bytes | bytearray) -> int:
    return zlib.crc32(content, zlib.crc32(struct.pack("<q", version)))
