"""Signals and garbage collection of the tests; `support/shared_fixtures.py` has the shared fixtures.

Tests may be started where signals are ignored: a script's `&` ignores SIGINT and SIGQUIT, nohup SIGHUP. A
child inherits that, and no Ctrl-C of a test reaches it. So every ignored signal gets a handler here, before
any child is started: exec sets a signal that has a handler back to its default. SIGINT gets Python's own
handler, as tests interrupt their own process too. The handler of the others does nothing, so that pytest
itself still outlives them, as nohup is meant to. SIGPIPE is left alone: Python ignores it, and subprocess
restores it in children.

Python collects garbage seldom: with torch imported, it would take a sixth of the time of a small command.
"""

import gc
import signal
from types import FrameType

import pytest

gc.set_threshold(100_000, 50, 100)  # before anything large is imported


def outlive(number: int, frame: FrameType | None) -> None:
    """Do nothing about a signal that was ignored."""


for name in ("SIGINT", "SIGHUP", "SIGQUIT", "SIGTERM"):  # Windows has the first and the last
    if hasattr(signal, name) and signal.getsignal(number := getattr(signal, name)) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else outlive)


def pytest_configure(config: pytest.Config) -> None:
    """Import the fixtures, and with them torch; not where pytest only hands tests to its workers."""
    if not config.getoption("numprocesses", None):
        config.pluginmanager.import_plugin("shared_fixtures")
