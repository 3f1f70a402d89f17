"""Ends a command: after an expected error with one line and an exit code, after a signal with its code.

Exit codes: 0; 1 where the work failed; 2 where the config is wrong; 130 after Ctrl-C; 143 after SIGTERM; 129
after SIGHUP, which a closed terminal or a dropped ssh connection sends; 141 where the reader of a pipe has
left.
"""

import errno
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from cartpole_rl.composition import error_message
from cartpole_rl.errors import CartPoleError, ConfigError, LearnerError, PlantError, reason_of
from cartpole_rl.files import FULL
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.terminal import exit_if_nobody_reads, print_message

SIGNALLED = 128  # added to the number of a signal, as a shell does
OF_HYDRA = (HydraException, OmegaConfBaseException)  # some of which are OSErrors too
FAILED = (PlantError, LearnerError, OSError)  # what may work at another time, with the same settings
EXPECTED = (CartPoleError, *OF_HYDRA, OSError)  # printed without a traceback
FOLDERS = "hydra.run.dir= or hydra.sweep.dir="  # of one run, and of a sweep
UNNAMED = {*FULL, errno.EFBIG, errno.EIO}  # of writing, which names no file


class Terminated(BaseException):
    """SIGTERM or SIGHUP arrived. It unwinds like an exception, so every `with` stops its motor."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def exit_with_message(name: str, error: Exception, plants: Collection[str] = ()) -> NoReturn:
    """Print an error and its notes, and exit; `plants` are those that the command takes.

    Raises an OSError that concerns no file.
    """
    if isinstance(error, BrokenPipeError):
        exit_if_nobody_reads()
    code = CartPoleError.exit_code
    if isinstance(error, CartPoleError):
        code = error.exit_code
    elif isinstance(error, OF_HYDRA):
        code = ConfigError.exit_code
    elif is_defect(error):
        raise error
    print_message(name, "; ".join([one_line(error, name, plants), *getattr(error, "__notes__", ())]))
    sys.exit(code)


def is_defect(error: Exception) -> bool:
    """Return True for an error of no expected kind, or an OSError that concerns no file."""
    if isinstance(error, OSError) and not isinstance(error, OF_HYDRA):
        return not error.filename and error.errno not in UNNAMED
    return not isinstance(error, EXPECTED)


def one_line(error: Exception, name: str, plants: Collection[str] = ()) -> str:
    """Return what cartpole-<name> prints of an error; with its class if it is a defect."""
    if isinstance(error, OF_HYDRA):
        if isinstance(error, OmegaConfBaseException) and (behind := error_behind(error, OSError)):
            reason = one_line(behind, name)  # of making a run folder
            return f"{reason}; give {FOLDERS} another folder"
        return error_message(error, name, sys.argv[1:], plants)
    if isinstance(error, OSError) and not is_defect(error):
        remedy = "; make room" if error.errno in FULL else ""
        if remedy and not any(word.startswith("resume=") for word in sys.argv):  # which keeps its folder
            remedy += f", or give {FOLDERS} a folder on another disk"
        return f"{error.filename or 'a file was not written'}: {error.strerror}{remedy}"
    first = reason_of(error)
    return f"{type(error).__name__}: {first}" if is_defect(error) else first


def exit_after_signal(name: str, signalled: BaseException) -> NoReturn:
    """Print which kind of signal ended the command and its notes, and exit."""
    number = signalled.number if isinstance(signalled, Terminated) else signal.SIGINT
    what = "interrupted" if number == signal.SIGINT else "terminated"
    print_message(name, "; ".join([what, *getattr(signalled, "__notes__", ())]))
    sys.exit(SIGNALLED + number)


def signal_behind(error: BaseException) -> BaseException | None:
    """Return what a signal raised, if `error` follows from it, as the error of an interrupted import."""
    return error_behind(error, KeyboardInterrupt, Terminated)


def error_behind(error: BaseException | None, *kinds: type[BaseException]) -> Any:
    """Return the error of one of these kinds that `error` is or follows from; None without one."""
    while error is not None and not isinstance(error, kinds):
        error = error.__cause__ or error.__context__
    return error


def catch_signals() -> None:
    """Make SIGTERM, SIGHUP and SIGINT raise, except for those that the parent process ignores."""
    handler = RaiseOnce(lambda number: KeyboardInterrupt() if number == signal.SIGINT else Terminated(number))
    handler.handle(*ending_signals())
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        handler.handle(signal.SIGINT)


@contextmanager
def job_signals() -> Iterator[None]:
    """Let SIGTERM, SIGHUP and SIGINT unwind a job in a process that a launcher started.

    The process then ends by that signal, which the launcher reports. Nothing changes in a thread, or where
    SIGTERM has a handler: that of `catch_signals`, or the launcher's.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ending_signals())}
    catch_signals()
    try:
        yield
    except Terminated as signalled:
        signal.signal(signalled.number, signal.SIG_DFL)
        signal.raise_signal(signalled.number)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
