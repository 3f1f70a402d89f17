"""Composes the configs of conf/ with Hydra, as the commands do."""

import contextlib
from collections.abc import Iterator

import hydra
from hydra.core.global_hydra import GlobalHydra

import cartpole_rl.commands.hydra_application.composition  # noqa: F401 - registers the resolvers that conf/ uses
from cartpole_rl.choices import conf_folder


@contextlib.contextmanager
def shipped_choices() -> Iterator[None]:
    """Let `hydra.compose` read conf/; a command that runs inside ends this."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
        yield
