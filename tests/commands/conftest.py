"""A trained run that several tests evaluate."""

from pathlib import Path

import pytest
from command_line import TINY, in_process, tells_only_how_it_goes


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training; with two actions its agent cannot but move the cart."""
    folder = tmp_path_factory.mktemp("trained")
    done = in_process("train", *TINY, "actions=two", "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    assert tells_only_how_it_goes(done), done
    return folder / "run"
