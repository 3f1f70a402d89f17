"""Recordings: episodes as CSV files, with units in the column names.

Lines `# key: value` describe the whole episode. A row is a control period: the measured state, then the motor
value chosen on it, its scores and reward. The last row, the end of the episode, has only the state. The
simulated cart and its initial state are stored as in metrics.json.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.files import replacing
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Encoders, hardware_of
from cartpole_rl.tasks.episode import Ending, Episode, Origin
from cartpole_rl.wire.messages import MOST_COUNTS

FORMAT = "cartpole_rl recording 1"
STATE = {  # column: field of Episode
    "time_s": "time",
    "x_m": "x",
    "x_dot_m_per_s": "x_dot",
    "theta_rad": "theta",
    "theta_dot_rad_per_s": "theta_dot",
}
STEP = {"score": "score", "score_upright": "score_upright", "reward": "reward"}
COUNTS = ("cart_counts", "pole_counts")
METRES, TURN = "cart_nanometres_per_count", "pole_counts_per_turn"  # in the heading; without them: ip02's
BEFORE = "motor_before"  # in the heading of a part of a log: its motor values before the first row
LENGTH = "pole_length_m"  # in the heading: twice pivot to centre of mass, empty if not known
GUARDED = "guarded"  # 1 where the track guard replaced the agent's motor value; empty without a guard
OF_STATE, OF_STEP = (*STATE, *COUNTS), ("motor", *STEP)
COLUMNS = (*OF_STATE, *OF_STEP)  # that every recording has
LARGEST = 1e6  # of any state, score or reward, in SI units
KINDS = {float: "a number", int: "a whole number"}


class Recording(NamedTuple):
    """An episode under its name, with the whole heading of its file."""

    name: str
    episode: Episode
    facts: Mapping[str, str]

    @property
    def pole_length(self) -> float | None:
        """The pole's length (m) in the heading; None where it has none. Raises RecordingError."""
        text = self.facts.get(LENGTH)
        if not text:
            return None
        try:
            length = float(text)
        except ValueError:
            length = math.nan
        if not 0 < length < math.inf:
            raise RecordingError(f"recording {self.name} is damaged: {LENGTH} is {text!r}, and not a length")
        return length


def write_recording(path: Path, episode: Episode, facts: Mapping[str, Any] | None = None) -> None:
    """Write one episode atomically; `facts` are added to the heading."""
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        left_out = {"left_out": episode.left_out} if episode.left_out else {}
        encoders = {METRES: round(1e9 * episode.encoders.metres), TURN: episode.encoders.turn}
        before = {BEFORE: " ".join(map(str, episode.motor_before))} if episode.motor_before else {}
        known = {"format": FORMAT, "ended_by": episode.ended_by, **encoders, **before, **left_out}
        heading = {**known, **(facts or {})}
        for key, value in heading.items():
            file.write(f"# {key}: {value}\n")
        lines = csv.DictWriter(file, (*COLUMNS, GUARDED))
        lines.writeheader()
        lines.writerows(rows_of(episode))


def rows_of(episode: Episode) -> list[dict[str, float]]:
    """Return the rows of a recording as numbers by column. The last one has only the state."""
    rows: list[dict[str, float]] = []
    for row, counts in enumerate(episode.counts.tolist()):
        state = {name: float(getattr(episode, field)[row]) for name, field in STATE.items()}
        rows.append({**state, **dict(zip(COUNTS, counts, strict=True))})
    for row, motor in enumerate(episode.motor.tolist()):
        step = {name: float(getattr(episode, field)[row]) for name, field in STEP.items()}
        guarded = {} if episode.guarded is None else {GUARDED: int(episode.guarded[row])}
        rows[row] |= {"motor": motor, **step, **guarded}
    return rows


def read_recording(path: Path) -> Recording:
    """Read a recording's file, also as a spreadsheet program saved it.

    Raises RecordingError if it is damaged or not a recording.
    """
    facts, text = read_heading(path)
    if facts.get("format") != FORMAT:
        raise RecordingError(f"{path} is not a recording: its first line is not '# format: {FORMAT}'")
    try:
        rows = list(csv.DictReader(text))
    except csv.Error as error:
        raise RecordingError(f"{path} is damaged: {error}; leave this recording out") from None
    return Recording(path.stem, episode_of(path, facts, rows), facts)


def episode_of(path: Path, facts: Mapping[str, str], rows: Sequence[Mapping[str, str]]) -> Episode:
    """Return the episode with the heading `facts` and `rows` of text cells; `path` is for messages.

    Raises RecordingError for what no recording can hold.
    """
    if missing := [name for name in COLUMNS if not rows or name not in rows[0]]:
        raise RecordingError(f"{path} lacks {', '.join(missing)}")
    if len(rows) < 2:
        raise RecordingError(f"{path} holds no control period")
    if rows[-1]["motor"] != "":
        raise RecordingError(f"{path} is damaged: its last row is missing")
    try:
        ended_by = str(Ending(facts.get("ended_by", "")))
    except ValueError as error:
        raise RecordingError(f"{path} is damaged: {error}") from None

    def column(name: str, rows: Sequence[Mapping[str, str]], kind: type[float] = float) -> np.ndarray:
        return np.array([_number(path, row, name, cells[name], kind) for row, cells in enumerate(rows)])

    columns: dict[str, Any] = {field: column(name, rows) for name, field in STATE.items()}
    steps: dict[str, Any] = {field: column(name, rows[:-1]) for name, field in STEP.items()}
    counts = np.stack([column(name, rows, int) for name in COUNTS], 1)
    motor = column("motor", rows[:-1], int)
    marks = [{GUARDED: row.get(GUARDED) or "0"} for row in rows[:-1]]
    has_guard = any(row.get(GUARDED) for row in rows[:-1])
    guarded = column(GUARDED, marks, int) != 0 if has_guard else None
    _check_numbers(path, {**columns, **steps}, motor, counts)
    return Episode(
        **columns,
        **steps,
        counts=counts,
        motor=motor,
        ended_by=ended_by,
        guarded=guarded,
        encoders=_encoders(path, facts),
        motor_before=_motor_before(path, facts.get(BEFORE, "")),
    )


def _motor_before(path: Path, text: str) -> tuple[int, ...]:
    """Return the motor values in a heading. Raises RecordingError for impossible ones."""
    try:
        values = tuple(map(int, text.split()))
        if any(abs(value) > LARGEST_MOTOR for value in values):
            raise ValueError
        return values
    except ValueError:
        raise RecordingError(
            f"{path} is damaged: in its heading, {BEFORE} is {text!r}; give whole numbers from "
            f"-{LARGEST_MOTOR} to {LARGEST_MOTOR}"
        ) from None


def _encoders(path: Path, facts: Mapping[str, str]) -> Encoders:
    """Return the encoders in a heading. Raises RecordingError for impossible ones."""
    try:
        return hardware_of({name: float(facts[name]) for name in (METRES, TURN) if name in facts}).encoders
    except (ValueError, ConfigError) as error:
        wrong = str(error).removeprefix("cart.")
        raise RecordingError(f"{path} is damaged: in its heading, {wrong}") from None


def read_heading(path: Path) -> tuple[dict[str, str], list[str]]:
    """Return what the heading of a file says, and its other lines. Raises RecordingError.

    Spreadsheet programs write a byte-order mark, quotes around a line, and commas that fill a row.
    """
    facts, text = {}, []
    try:
        for line in path.read_text(encoding="utf-8-sig").splitlines():
            if line.lstrip('"').startswith("#"):
                key, _, value = line.strip('",#').partition(":")
                facts[key.strip()] = value.strip()
            else:
                text.append(line)
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from None
    return facts, text


def _number(path: Path, row: int, column: str, cell: str | None, kind: type[float]) -> float:
    """Return a cell as `kind`; a whole number may be written as -250.0. Raises RecordingError."""
    try:
        value = float(cell or "")
        if kind is int and not value.is_integer():
            raise ValueError
        return kind(value)
    except ValueError:
        found = f"is {cell!r}" if cell else "is empty"
        raise RecordingError(
            f"{path} is damaged: {column} in row {row + 1} {found}; give {KINDS[kind]}, "
            "or leave this recording out"
        ) from None


def _check_numbers(
    path: Path, columns: Mapping[str, np.ndarray], motor: np.ndarray, counts: np.ndarray
) -> None:
    """Raise RecordingError for the first impossible number."""

    def damaged(row: int, what: str) -> RecordingError:
        return RecordingError(f"{path} is damaged: {what} in row {row + 1}; record it again, or leave it out")

    for name, values in columns.items():
        if not np.isfinite(values).all():
            raise damaged(int(np.flatnonzero(~np.isfinite(values))[0]), f"{name} is not finite")
        if (beyond := np.abs(values) > LARGEST).any():
            raise damaged(int(np.flatnonzero(beyond)[0]), f"{name} is beyond {LARGEST:g}")
    if not (steps := np.diff(columns["time"]) > 0).all():
        raise damaged(int(np.flatnonzero(~steps)[0]) + 1, "the time does not increase")
    if (beyond := (motor < -LARGEST_MOTOR) | (motor > LARGEST_MOTOR)).any():
        raise damaged(int(np.flatnonzero(beyond)[0]), f"a motor value is beyond {LARGEST_MOTOR}")
    if (beyond := (counts < -MOST_COUNTS - 1) | (counts > MOST_COUNTS)).any():
        raise damaged(int(np.flatnonzero(beyond.any(axis=1))[0]), f"a count is beyond {MOST_COUNTS}")


def stored_origins(episodes: Sequence[Episode]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the parameters that all simulated carts share, and the rest for each, for metrics.json.

    Both are empty if a cart was not simulated. `read_origin` is the inverse.
    """
    stored = [stored_origin(episode.origin) for episode in episodes if episode.origin is not None]
    if len(stored) < len(episodes):
        return {}, [{} for _ in episodes]
    carts = [each["cart"] for each in stored]
    shared = {name: value for name, value in carts[0].items() if all(cart[name] == value for cart in carts)}
    own = [{name: value for name, value in cart.items() if name not in shared} for cart in carts]
    return {"cart": shared}, [{**each, "cart": cart} for each, cart in zip(stored, own, strict=True)]


def stored_origin(origin: Origin) -> dict[str, dict[str, float]]:
    """Return a cart and its initial state with numbers as short as possible."""
    return {
        "cart": {name: as_stored(value) for name, value in origin.parameters.items()},
        "start": {name: as_stored(value) for name, value in origin.state.items()},
    }


def read_origin(metrics: Mapping[str, Any], number: int) -> Origin:
    """Return the cart and the initial state of an episode in metrics.json. Raises LookupError."""
    episode = metrics["episodes"][number]
    return Origin({**metrics["cart"], **episode["cart"]}, episode["start"])


def as_stored(value: float) -> float:
    """Return the shortest number that is `value` as float32: 0.7 instead of 0.699999988079071."""
    short = float(str(np.float32(value)))
    return short if np.float32(short) == np.float32(value) else value
