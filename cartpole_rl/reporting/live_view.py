"""The text of the live view of a cart: a few lines with bars, for a terminal of any width.

Colours are used only with `colour`: green for an upright pole, red for the track guard and late ticks.
"""

import math

from cartpole_rl.evaluation.snapshots import Snapshot
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

LINES = 7
LABEL = 7  # characters before a bar
VALUE = 24  # characters after a bar
WIDEST = 100  # characters of a line
GREEN, RED, PLAIN = "\x1b[32m", "\x1b[31m", "\x1b[0m"


def view(title: str, snapshot: Snapshot | None, fresh: bool, width: int, colour: bool) -> list[str]:
    """Return LINES lines of at most `width` characters; a snapshot that is not `fresh` is of the past."""
    width = min(width, WIDEST)
    rule = "-" * width
    if snapshot is None:
        waiting = [title, "waiting for the cart to start its first episode"]
        return [cut(line, width) for line in [*waiting, *[""] * (LINES - 3), rule]]
    state = f"step {snapshot.step}" if fresh else f"ended at step {snapshot.step}"
    heading = f"{title}: episode {snapshot.episode}, {state}"
    return [
        cut(heading, width),
        *(painted(cut(line, width), tint, colour) for line, tint in gauges(snapshot, width)),
        rule,
    ]


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
        (f"{'score':<{LABEL}}{snapshot.score:.0f}   track guard {guard}", RED if snapshot.guard else ""),
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


def cut(line: str, width: int) -> str:
    """Return a line without what exceeds `width`."""
    return line[:width]


def painted(line: str, tint: str, colour: bool) -> str:
    """Return a line in a colour, if colours are used."""
    return f"{tint}{line}{PLAIN}" if tint and colour else line
