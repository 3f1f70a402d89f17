"""Composes the configs of conf/ with Hydra, as the commands do."""

import contextlib
from collections.abc import Iterator

import cartpole_rl.sweeps  # noqa: F401 - registers the resolvers that conf/ uses
from cartpole_rl.composition import reading_conf


@contextlib.contextmanager
def shipped_choices() -> Iterator[None]:
    """Let `hydra.compose` read conf/; a command that runs inside ends this."""
    with reading_conf():
        yield
