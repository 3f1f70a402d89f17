"""The live view of a cart in the terminal, drawn by a process of its own so that it cannot delay a tick.

The process imports no PyTorch, so that it starts at once. The view has the top lines of the terminal; all
else that is printed scrolls below. Without a terminal, or with TERM=dumb, there is no view. An upright pole
is green, the track guard and late ticks are red; NO_COLOR turns colours off.
"""

import math
import multiprocessing
import os
import shutil
import signal
import sys
import time
from contextlib import suppress
from typing import NoReturn

from cartpole_rl.evaluation.snapshots import Memory, Snapshot, new_memory, read
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.scheduling import giving_precedence
from cartpole_rl.signals import end_with_parent, kept_from_children
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

LINES = 7
LABEL = 7  # characters before a bar
VALUE = 24  # characters after a bar
WIDEST = 100  # characters of a line
GREEN, RED, PLAIN = "\x1b[32m", "\x1b[31m", "\x1b[0m"
INTERVAL = 0.1  # s between two pictures
FRESH = 0.5  # s after which a snapshot that does not change is of an episode that has ended
SAVE, RESTORE, CLEAR_LINE, ALL_LINES = "\x1b7", "\x1b8", "\x1b[2K", "\x1b[r"


class LiveView:
    """A context manager of the process that shows snapshots from `memory`, which is None without a view."""

    def __init__(self, title: str, chosen: str) -> None:
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
            with kept_from_children():
                self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.memory is None:
            return
        self._process.kill()  # it has nothing to save, and may be suspended
        self._process.join()
        with suppress(OSError):  # the terminal is closed
            put(f"{SAVE}{ALL_LINES}{RESTORE}")


def has_cursor() -> bool:
    """Return True if stderr is a terminal that can move its cursor."""
    return sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM", "") not in ("", "dumb")


def terminal_size() -> os.terminal_size:
    """Return the size of the terminal behind stderr, on which the view is drawn; stdout may be a file."""
    with suppress(OSError, ValueError):  # closed, or no terminal
        if (size := os.get_terminal_size(sys.stderr.fileno())).columns:
            return size
    return shutil.get_terminal_size()


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
        number, snapshot = read(memory) or (0, None)
        if number != newest:
            newest, changed = number, time.monotonic()
        columns, rows = terminal = terminal_size()
        if size != terminal:
            size = columns, rows
            below = LINES + 1  # what is printed there scrolls; the cursor goes there
            put(f"\x1b[{below};{max(rows, below + 1)}r\x1b[{below};1H")
        put(picture(view(title, snapshot, time.monotonic() - changed < FRESH, columns - 1, colour)))
        time.sleep(INTERVAL)


def picture(lines: list[str]) -> str:
    """Return what draws lines at the top of the terminal and leaves the cursor where it was."""
    drawn = "".join(f"\x1b[{row};1H{CLEAR_LINE}{line}" for row, line in enumerate(lines, 1))
    return f"{SAVE}{drawn}{RESTORE}"


def put(text: str) -> None:
    """Write to the terminal in one piece; nothing is buffered."""
    os.write(sys.stderr.fileno(), text.encode())


def view(title: str, snapshot: Snapshot | None, fresh: bool, width: int, colour: bool) -> list[str]:
    """Return LINES lines of at most `width` characters; a snapshot that is not `fresh` is of the past."""
    width = min(width, WIDEST)
    rule = "-" * width
    if snapshot is None:
        waiting = [title, "waiting for the cart to start its first episode"]
        return [line[:width] for line in [*waiting, *[""] * (LINES - 3), rule]]
    state = f"step {snapshot.step}" if fresh else f"ended at step {snapshot.step}"
    heading = f"{title}: episode {snapshot.episode}, {state}"
    shown = [(line[:width], tint if colour else "") for line, tint in gauges(snapshot, width)]
    return [heading[:width], *(f"{tint}{line}{PLAIN}" if tint else line for line, tint in shown), rule]


def gauges(snapshot: Snapshot, width: int) -> list[tuple[str, str]]:
    """Return the lines between heading and rule, each with its colour."""
    lean = math.remainder(snapshot.theta, 2 * math.pi)
    upright = GREEN if abs(lean) < UPRIGHT_ANGLE else ""
    guard = {0: "off", 1: "pushes right", -1: "pushes left"}[snapshot.guard]
    place = f"{100 * snapshot.x:+6.1f} cm {snapshot.x_dot:+6.2f} m/s"
    angle = f"{math.degrees(lean):+6.1f} deg {snapshot.theta_dot:+6.2f} rad/s"
    late = f"late ticks {snapshot.late_ticks}   lost frames {snapshot.lost_frames}"
    return [
        (gauge("cart", snapshot.x / snapshot.track_half_length, place, width), ""),
        (gauge("pole", lean / math.pi, angle, width), upright),
        (gauge("motor", snapshot.motor / LARGEST_MOTOR, f"{snapshot.motor:+5d}", width), ""),
        (f"{'score':<{LABEL}}{snapshot.score:z.0f}   track guard {guard}", RED if snapshot.guard else ""),
        (f"{'link':<{LABEL}}{late}", RED if snapshot.late_ticks else ""),
    ]


def gauge(label: str, share: float, value: str, width: int) -> str:
    """Return a line with a mark at `share`, -1 to 1 from left to right, on a bar as long as fits."""
    inner = width - LABEL - VALUE - 3
    if inner < 9:
        return f"{label:<{LABEL}}{value}"
    half = inner // 2
    cells = [" "] * (2 * half + 1)
    cells[half] = "."
    cells[half + round(max(-1.0, min(1.0, share)) * half)] = "#"
    return f"{label:<{LABEL}}[{''.join(cells)}]{value}"
