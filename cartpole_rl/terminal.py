"""The terminal: messages, questions, progress bars, and text that survives a shell and Hydra."""

import errno
import os
import re
import select
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

READER_LEFT = 141  # exit code, as of a program that SIGPIPE ends
BLINK = 1.0  # s, between two updates of a line about work under way
_words: list[str] = []  # of the command line, while a command runs
_under_way: list["_Work"] = []  # the blocks of `waiting`, innermost last


@dataclass(eq=False)
class _Work:
    """A block of `waiting`: its text, or "" to show nothing, when it began, and when it was shown last, s."""

    text: str
    began: float
    shown: float


def confirm(text: str) -> bool:
    """Show `text` and wait for Enter. Return False at once if standard input is not a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    with waiting(""):
        print(f"{text}.", file=sys.stderr)
        print("Check the cart. It homes as soon as you confirm: keep the track clear.", file=sys.stderr)
        discard_typed()
        print("Press Enter to continue, Ctrl-C to stop. ", end="", file=sys.stderr, flush=True)
        with suppress(EOFError):
            input()
            return True
    return False


def discard_typed() -> None:
    """Discard what was typed before the question."""
    try:
        import termios
    except ImportError:  # Windows
        import msvcrt

        while msvcrt.kbhit():  # type: ignore[attr-defined]
            msvcrt.getwch()  # type: ignore[attr-defined]
        return
    termios.tcflush(sys.stdin, termios.TCIFLUSH)


def program(verb: str) -> str:
    """Return the name of the program of a verb: "cartpole-find-port"."""
    return f"cartpole-{verb.replace('_', '-')}"


def print_message(verb: str, message: str) -> None:
    """Print one line of a verb's program on stderr; do nothing if the terminal is closed."""
    with suppress(OSError):
        print(f"{program(verb)}: {message}", file=sys.stderr)


@contextmanager
def unless_closed() -> Iterator[None]:
    """Leave the `with` quietly where a print finds the terminal closed."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.EIO:
            raise


def as_word(name: str, value: object) -> str:
    """Return an override for a command line: "run=runs/train/first"."""
    return f"{name}={as_value(value)}"


def as_value(value: object) -> str:
    """Return a value for a command line, in quotes where Hydra and the shell need them."""
    if isinstance(value, list | tuple):
        return shlex.quote(f"[{','.join(map(str, value))}]")
    if isinstance(value, Mapping):
        return shlex.quote(f"{{{','.join(f'{name}:{each}' for name, each in value.items())}}}")
    text = "null" if value is None else str(value)
    return shlex.quote(text if re.fullmatch(r"[A-Za-z0-9_./:%+-]+", text) else in_quotes(text))


def in_quotes(text: str) -> str:
    """Return `text` in the quotes that Hydra reads."""
    return '"' + re.sub(r'(\\*)("|$)', lambda end: 2 * end[1] + end[2].replace('"', '\\"'), text) + '"'


def exit_if_nobody_reads() -> None:
    """Exit with READER_LEFT if the reader of standard output, such as `head`, has left."""
    try:
        print(flush=True)  # a flush alone may find the text of the failed one gone
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for Python's last flush
        sys.exit(READER_LEFT)


def progress_bar(total: int | None, unit: str, **options: Any) -> Any:
    """Return a bar of `total` units on stderr, as wide as the terminal; without a total, it counts them.

    Options are those of tqdm. Only a terminal gets one: a pipe or a log file would keep every repaint.
    """
    from tqdm import tqdm

    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    return tqdm(total=total, unit=f" {unit}", dynamic_ncols=True, disable=not is_terminal, **options)


@contextmanager
def waiting(text: str, *, thread: bool = True) -> Iterator[None]:
    """Show `text` and the seconds so far on a terminal's stderr while the block runs.

    Progress bars are updated instead if there are any. A block inside another one shows its own text; with ""
    nothing is shown. A thread does it; without one, a loop that keeps a cart's time calls `beat`.
    """
    # a process that was started by another one shares its terminal and leaves it alone
    processes = sys.modules.get("multiprocessing.process")
    is_child = processes is not None and processes.parent_process() is not None
    if sys.stderr is None or not sys.stderr.isatty() or is_child:
        yield
        return
    ended, began = threading.Event(), time.monotonic()
    work = _Work(text, began, began)
    _under_way.append(work)

    def show() -> None:
        while not ended.wait(BLINK):
            if work in _under_way[-1:]:
                _show(work)

    showing = threading.Thread(target=show, daemon=True) if thread and text else None
    if showing:
        showing.start()
    try:
        yield
    finally:
        ended.set()
        if showing:
            showing.join()
        with suppress(ValueError):  # a block that outlived the one around it, as in a generator, is gone
            del _under_way[_under_way.index(work) :]
        if text and time.monotonic() - began > BLINK and (thread or _takes_text()):
            _clear(work)


def beat() -> None:
    """Show the innermost block of `waiting` again after a second, if the terminal takes text at once.

    For a loop that keeps a cart's time. It calls this with time to spare, before it waits for the cart.
    """
    if not _under_way or time.monotonic() - _under_way[-1].shown < BLINK:
        return
    _under_way[-1].shown = time.monotonic()
    if _takes_text():
        _show(_under_way[-1])


def _takes_text() -> bool:
    """Return True for a terminal that takes text at once: a stopped one (Ctrl-S) holds up a loop."""
    with suppress(OSError, ValueError):  # it is closed, or cannot be asked, as on Windows
        return bool(select.select([], [sys.stderr], [], 0)[1])
    return False


def _show(work: _Work) -> None:
    """Show a line that the next one replaces, or update the progress bars, which an inner block names."""
    if not work.text:
        return
    if bars := _bars():
        for bar in bars:
            if work is not _under_way[0]:
                bar.set_description_str(work.text, refresh=False)
            bar.refresh()
    else:
        _write(f"\r\x1b[K{work.text}, {time.monotonic() - work.began:.0f} s\r")


def _clear(work: _Work) -> None:
    """Remove the line of a block that has ended, or its name from the progress bars."""
    if not (bars := _bars()):
        _write("\r\x1b[K")
    for bar in bars:
        if bar.desc == work.text and _under_way:
            bar.set_description_str("", refresh=False)


def _bars() -> list[Any]:
    """Return the progress bars that are shown."""
    tqdm = sys.modules.get("tqdm")
    shown = [*getattr(tqdm.tqdm, "_instances", ())] if tqdm else []
    return [bar for bar in shown if not bar.disable]


def _write(text: str) -> None:
    with suppress(OSError, ValueError):  # the terminal is closed
        sys.stderr.write(text)
        sys.stderr.flush()


@contextmanager
def noting(words: Sequence[str]) -> Iterator[None]:
    """Within the `with`, let `words` be those of the command line: in a job of a sweep, its own."""
    _words[:] = words
    try:
        yield
    finally:
        _words.clear()


def words_given(*settings: str) -> list[str]:
    """Return the words of the command line that give these settings or parts of them, quoted for a shell."""
    names = ((re.split(r"[.=]", word.lstrip("+"))[0], word) for word in _words)
    return [shlex.quote(word) for name, word in names if name in settings]


def print_results(folder: Path, files: str, following: str | None) -> None:
    """Print that `files` are in `folder`, and the command `following`, if there is one."""
    print(f"{shown(folder)}/{files} are written{'; next:' if following else ''}")
    if following:
        print(following)


def print_loop_time(override: str | None) -> None:
    """Print the measured loop time of `LinkStatistics.latency_override`, if there is one."""
    if override is not None:
        print(
            "measured loop time as an override of cartpole-train; add the latency that cartpole-preflight "
            f"prints to both numbers: '{override}'"
        )


def shown(path: Path) -> Path:
    """Return `path` relative to the working directory if it is below it."""
    with suppress(ValueError):
        return path.resolve().relative_to(Path.cwd())
    return path
