"""Children of a test start with default signals, also where pytest was started with signals ignored."""

import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="only POSIX lets a child inherit ignored signals")

NAMES = ("SIGINT", "SIGHUP", "SIGQUIT", "SIGTERM")
CHILD = """
import signal, sys
print([name for name in sys.argv[1:] if signal.getsignal(getattr(signal, name)) is signal.SIG_IGN])
"""
IGNORING = "trap '' INT HUP QUIT TERM; exec \"$@\""  # for sh


def ignored(*before: str) -> str:
    """The signals, of NAMES, that a Python program started by the words `before` ignores."""
    command = [*before, sys.executable, "-S", "-c", CHILD, *NAMES]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_a_child_program_ignores_no_signal() -> None:
    assert ignored("sh", "-c", IGNORING, "sh") == str(list(NAMES))  # so an ignored one is seen
    assert ignored() == "[]"


def test_a_spawned_process_ignores_no_signal() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        handlers = {name: pool.apply(signal.getsignal, (getattr(signal, name),)) for name in NAMES}
    assert signal.SIG_IGN not in handlers.values(), handlers


def test_an_interrupt_is_raised_in_this_process() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.nightly
def test_also_where_pytest_was_started_with_signals_ignored() -> None:
    """As a script's `&` and nohup start it."""
    others = [
        f"{__file__}::{test.__name__}"
        for test in (
            test_a_child_program_ignores_no_signal,
            test_a_spawned_process_ignores_no_signal,
            test_an_interrupt_is_raised_in_this_process,
        )
    ]
    pytest_again = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *others]
    done = subprocess.run(["sh", "-c", IGNORING, "sh", *pytest_again], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
