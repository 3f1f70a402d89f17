"""Signals that end a process, turned into exceptions where a cart is driven.

An exception unwinds every `with`: the motor is at 0 and the cart disarmed before the process ends.
"""

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# s after a signal during which others are ignored: they would interrupt the unwinding. Stopping a cart that
# does not answer takes up to 7 s: LONGEST_STOP, LAST_STOP and LONGEST_WRITE in `plants.serial`.
UNWINDING = 7.5
AGAIN = 0.1  # s
NUMBER = "signal_number"  # the attribute of an error that a signal raised
PARENT_POLL = 0.5  # s
PARENT = "CARTPOLE_RL_PARENT"  # in the environment of a process that serves a cart: the one that started it


def ending_signals() -> list[signal.Signals]:
    """Return SIGTERM and SIGHUP (a closed terminal, a dropped ssh connection).

    A SIGHUP that the parent process ignores stays ignored, as nohup needs it.
    """
    ending = [signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        ending.append(signal.SIGHUP)
    return ending


class RaiseOnce:
    """A signal handler that raises `error(number)`, and ignores further signals for UNWINDING s.

    A second signal could otherwise leave a `with` before the motor is stopped. Later signals raise again, so
    a program that hangs can still be ended. Where Python swallows the error, as in a destructor, the signal
    comes once more. While the interpreter ends, they are ignored: the exit code is that of the first signal.
    """

    def __init__(self, error: Callable[[int], BaseException]) -> None:
        self._error = error
        self._raised_at = -UNWINDING
        self._unraisable: Callable[[sys.UnraisableHookArgs], object] = sys.unraisablehook

    def handle(self, *numbers: int) -> None:
        """Handle these signals from now on."""
        for number in numbers:
            signal.signal(number, self)
        atexit.register(self._ignore)
        earlier = getattr(sys.unraisablehook, "__self__", None)
        self._unraisable = earlier._unraisable if isinstance(earlier, RaiseOnce) else sys.unraisablehook
        sys.unraisablehook = self._swallowed

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise, unless the last error may still be unwinding."""
        now = time.monotonic()
        if now - self._raised_at >= UNWINDING:
            atexit.register(self._ignore)  # once more: before what packages registered since `handle`
            self._raised_at, error = now, self._error(number)
            vars(error)[NUMBER] = number
            raise error

    def _swallowed(self, unraisable: "sys.UnraisableHookArgs") -> None:
        """Let the signal come again if Python swallowed its error; later, or it would swallow that too."""
        if (number := getattr(unraisable.exc_value, NUMBER, None)) is not None:
            self._raised_at = -UNWINDING
            again = threading.Timer(AGAIN, send_to_main_thread, [number])
            again.daemon = True
            again.start()
        self._unraisable(unraisable)

    def _ignore(self) -> None:
        """Ignore the signals that are still handled here: Python would set them to their defaults."""
        for number in (signal.SIGINT, *ending_signals()):
            if signal.getsignal(number) is self:
                signal.signal(number, signal.SIG_IGN)


@contextmanager
def until_stopped() -> Iterator[None]:
    """End the block without an error on SIGINT, SIGTERM or SIGHUP; a second does not end its unwinding."""
    interrupt = RaiseOnce(lambda number: KeyboardInterrupt())
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, *ending_signals())}
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def kept_from_children() -> Iterator[None]:
    """Keep SIGINT and SIGHUP from the processes that start in the block, and from multiprocessing's helper.

    A terminal sends these signals to all of its processes; the one that started them ends them.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def send_to_main_thread(number: int) -> None:
    """Send a signal so that it ends what the main thread waits for; on Windows it comes after that."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def starting_process() -> int:
    """Return the process that started this one, also if it has ended since: `PARENT` in the environment."""
    given = os.environ.pop(PARENT, "")  # on Windows the parent may be a launcher of Python
    return int(given) if given and os.name == "posix" else os.getppid()


def end_with_parent(parent: int) -> None:
    """Start a thread that sends SIGTERM to this process once `parent` is no longer its parent."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_POLL)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
