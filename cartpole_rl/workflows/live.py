"""The live view of a cart in the terminal, drawn by a process of its own so that it cannot delay a tick.

The process imports no PyTorch, so that it starts at once. The view has the top lines of the terminal; all
else that is printed scrolls below. Without a terminal, or with TERM=dumb, there is no view. NO_COLOR turns
colours off.
"""

import multiprocessing
import os
import shutil
import signal
import sys
import time
from contextlib import suppress
from types import TracebackType
from typing import NoReturn

from cartpole_rl.evaluation.snapshots import Memory, new_memory, read
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.reporting.live_view import LINES, view
from cartpole_rl.scheduling import giving_precedence
from cartpole_rl.settings import Settings
from cartpole_rl.signals import end_with_parent
from cartpole_rl.workflows.config import View

INTERVAL = 0.1  # s between two pictures
FRESH = 0.5  # s after which a snapshot that does not change is of an episode that has ended
SAVE, RESTORE, CLEAR_LINE, ALL_LINES = "\x1b7", "\x1b8", "\x1b[2K", "\x1b[r"


class LiveView:
    """A context manager of the process that shows snapshots from `memory`, which is None without a view."""

    def __init__(self, title: str, chosen: View) -> None:
        self.memory: Memory | None = None
        if chosen == "live" and not has_cursor():
            print("view=live needs a terminal; the cart is driven without it", file=sys.stderr)
        elif chosen == "live":
            self.memory = new_memory()
            context = multiprocessing.get_context("spawn")
            arguments = (self.memory, title, os.getpid())
            self._process = context.Process(target=show, args=arguments, daemon=True)

    def __enter__(self) -> "LiveView":
        if self.memory is not None:
            self._process.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.memory is None:
            return
        self._process.terminate()
        self._process.join()
        with suppress(OSError):  # the terminal is closed
            put(f"{SAVE}{ALL_LINES}{RESTORE}")


def view_title(plant: Settings) -> str:
    """Return the name of a cart in the heading."""
    return f"cart on {plant.port}" if isinstance(plant, SerialSettings) else "emulated cart"


def has_cursor() -> bool:
    """Return True if stderr is a terminal that can move its cursor."""
    return sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM", "") not in ("", "dumb")


def show(memory: Memory, title: str, parent: int) -> None:
    """Draw the newest snapshot at the lowest priority, until the process is ended or its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    end_with_parent(parent)
    with giving_precedence():
        draw(memory, title, colour=not os.environ.get("NO_COLOR"))


def draw(memory: Memory, title: str, colour: bool) -> NoReturn:
    """Draw the newest snapshot again and again."""
    newest, changed, size = 0, time.monotonic(), (0, 0)
    while True:
        found = read(memory)
        number, snapshot = found or (0, None)
        if number != newest:
            newest, changed = number, time.monotonic()
        columns, rows = terminal = shutil.get_terminal_size()
        if size != terminal:
            size = columns, rows
            put(reserved(rows))
        put(picture(view(title, snapshot, time.monotonic() - changed < FRESH, columns - 1, colour)))
        time.sleep(INTERVAL)


def reserved(rows: int) -> str:
    """Return what keeps the top lines of a terminal from scrolling; the cursor goes below them."""
    return f"\x1b[{LINES + 1};{max(rows, LINES + 2)}r\x1b[{LINES + 1};1H"


def picture(lines: list[str]) -> str:
    """Return what draws lines at the top of the terminal and leaves the cursor where it was."""
    drawn = "".join(f"\x1b[{row};1H{CLEAR_LINE}{line}" for row, line in enumerate(lines, 1))
    return f"{SAVE}{drawn}{RESTORE}"


def put(text: str) -> None:
    """Write to the terminal in one piece; nothing is buffered."""
    os.write(sys.stderr.fileno(), text.encode())
