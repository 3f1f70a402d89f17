"""A trained run that several tests evaluate."""

from pathlib import Path

import pytest
from command_line import TINY, in_process


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training."""
    folder = tmp_path_factory.mktemp("trained")
    done = in_process("train", *TINY, "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    return folder / "run"
