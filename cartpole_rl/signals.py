"""Signals that ask a process to end. A program that drives a cart turns them into exceptions.

An exception unwinds every `with`, so that the motor is at 0 and the cart disarmed before the process ends.
"""

import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType

UNWINDING = 5.0  # s after a signal in which others are ignored, so that they do not interrupt the unwinding
PARENT_POLL = 0.5  # s


def ending_signals() -> list[signal.Signals]:
    """SIGTERM, and SIGHUP: a closed terminal, a dropped ssh connection.

    A SIGHUP that the parent process ignores stays ignored, since that is what nohup is for.
    """
    ending = [signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        ending.append(signal.SIGHUP)
    return ending


class RaiseOnce:
    """A signal handler that raises `error(number)`, and ignores what comes while that unwinds.

    A second signal would otherwise break out of a `with` before it has stopped its motor. Signals that come
    more than UNWINDING s after the first one raise again, so that a program which hangs can still be ended.
    """

    def __init__(self, error: Callable[[int], BaseException]) -> None:
        self._error = error
        self._raised_at = -UNWINDING

    def handle(self, *numbers: int) -> None:
        """Handle these signals from now on."""
        for number in numbers:
            signal.signal(number, self)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise, unless the last one is still unwinding."""
        now = time.monotonic()
        if now - self._raised_at >= UNWINDING:
            self._raised_at = now
            raise self._error(number)


def end_with_parent(parent: int) -> None:
    """From now on, behave as on SIGTERM once process `parent` is no longer the parent."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_POLL)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
