"""An agent as plain numbers: its description and its layers. No PyTorch.

The greedy action is the index of the largest action value. With h = observation, each layer but the last is

    h = relu(gain * normalized(weight @ h + bias) + shift)

where `normalized` subtracts the mean and divides by the standard deviation (of the variance plus
`norm_epsilon`), in each of `norm_groups` equal parts of the vector. Without layer normalization it is
h = relu(weight @ h + bias). The last layer is weight @ h + bias.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import CheckpointError
from cartpole_rl.exporting.description import Description

Floats = NDArray[np.float32]


class Layer(NamedTuple):
    """A layer; `gain` and `shift` are None where nothing is normalized."""

    weight: Floats  # [outputs, inputs]
    bias: Floats  # [outputs]
    gain: Floats | None = None  # [outputs]
    shift: Floats | None = None  # [outputs]


@dataclass(frozen=True)
class ExportedAgent:
    """An agent as plain numbers."""

    description: Description
    layers: tuple[Layer, ...]

    def arrays(self) -> Iterator[tuple[str, Floats]]:
        """Yield each array with its name, such as layer0.weight."""
        for number, layer in enumerate(self.layers):
            for name, values in layer._asdict().items():
                if values is not None:
                    yield f"layer{number}.{name}", values

    @property
    def json(self) -> str:
        """The description and the checksum as JSON."""
        content = {**self.description.model_dump(mode="json"), "sha256": self.checksum}
        return json.dumps(content, indent=1, allow_nan=False)

    @property
    def checksum(self) -> str:
        """SHA-256, in hexadecimal, of the description and of each array: it identifies the agent, not a file.

        The description is JSON with sorted keys, without spaces, in ASCII. Each array is its name and shape
        as text, as in "layer0.bias [128]", and its float32 numbers, row by row, little-endian.
        """
        return self._digest(self.description.model_dump(mode="json"))

    @property
    def identity(self) -> int:
        """The 32 bits that a board reports of its agent, never 0: such a checksum without the provenance."""
        functional = self.description.model_dump(mode="json", exclude={"provenance"})
        return int(self._digest(functional)[:8], 16) or 1

    def _digest(self, description: dict[str, Any]) -> str:
        digest = hashlib.sha256(canonical_json(description).encode())
        for name, values in self.arrays():
            digest.update(f"{name} {list(values.shape)}".encode())
            digest.update(np.ascontiguousarray(values, "<f4").tobytes())
        return digest.hexdigest()

    def check(self, source: str) -> None:
        """Raise CheckpointError, which names `source`, if the parts do not fit or a weight is not finite."""
        if not self.description.is_consistent:
            raise CheckpointError(f"{source}: its description contradicts itself; export the agent again")
        expected = dict(self.description.shapes())
        found = dict(self.arrays())
        for name in sorted({*expected, *found}):
            shape = found[name].shape if name in found else None
            if shape != expected.get(name):
                raise CheckpointError(
                    f"{source}: {name} has shape {shape}, not {expected.get(name)}; export the agent again"
                )
            if not np.isfinite(found[name]).all():
                raise CheckpointError(f"{source}: {name} is not finite; export another checkpoint")


def canonical_json(values: Any) -> str:
    """Return JSON with sorted keys and without spaces."""
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
