"""The weights file: a NumPy archive (.npz) with the arrays of each layer, and agent.json. No PyTorch.

It is a zip file without pickled objects: `unzip` opens it, and `numpy.load` reads it in any program.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from cartpole_rl.errors import CheckpointError
from cartpole_rl.exporting.agent import ExportedAgent, Layer, canonical_json
from cartpole_rl.exporting.description import FORMAT, Description

DESCRIPTION = "agent.json"
FLOATS = np.dtype("<f4")
EPOCH = (1980, 1, 1, 0, 0, 0)  # of every member, so that equal agents make equal files


def weights_file(agent: ExportedAgent) -> bytes:
    """Return the content of a weights file."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(DESCRIPTION, EPOCH), agent.json + "\n")
        for name, values in agent.arrays():
            content = io.BytesIO()
            np.save(content, values.astype(FLOATS), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", EPOCH), content.getvalue())
    return file.getvalue()


def read_agent(path: Path) -> ExportedAgent:
    """Read a weights file and check all of it: format, shapes, finite numbers, checksum.

    Raises CheckpointError in one line.
    """
    values, arrays = read_archive(path)
    checksum = values.pop("sha256", None)
    if values.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: its format is {values.get('format')!r}, not {FORMAT!r}; export it again"
        )
    try:
        description = Description(**values)
    except ValidationError as error:
        wrong = ".".join(map(str, error.errors()[0]["loc"]))
        raise CheckpointError(f"{path}: {wrong} in {DESCRIPTION} is wrong; export the agent again") from None
    agent = ExportedAgent(description, layers_of(arrays))
    agent.check(str(path))
    if len(arrays) != len(dict(agent.arrays())) or agent.checksum != checksum:
        raise CheckpointError(f"{path}: its content does not match its checksum; export the agent again")
    return agent


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the JSON and the arrays of a weights file. Raises CheckpointError."""
    if not path.is_file():
        raise CheckpointError(
            f"{path}: there is no such file; give one that cartpole-export format=weights wrote"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        values = json.loads(content.pop(DESCRIPTION))
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        canonical_json(values)  # refuses infinite numbers
        if any(not isinstance(each, np.ndarray) or each.dtype != FLOATS for each in content.values()):
            raise ValueError("a member is not an array of float32")
    except Exception as error:  # a damaged zip file raises errors of many kinds
        raise CheckpointError(
            f"{path} is not a weights file, or is damaged ({type(error).__name__}); "
            "give one that cartpole-export format=weights wrote"
        ) from None
    return values, content


def layers_of(arrays: dict[str, Any]) -> tuple[Layer, ...]:
    """Return the layers in the arrays of a file; missing parts are empty arrays, which `check` reports."""
    count = sum(name.endswith(".weight") for name in arrays)
    nothing = np.zeros(0, np.float32)
    return tuple(
        Layer(
            *(arrays.get(f"layer{number}.{name}", nothing) for name in ("weight", "bias")),
            *(arrays.get(f"layer{number}.{name}") for name in ("gain", "shift")),
        )
        for number in range(count)
    )
