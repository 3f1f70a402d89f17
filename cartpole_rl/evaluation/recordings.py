"""Recordings: episodes as CSV files, with units in the column names.

Lines `# key: value` describe the whole episode. A row is a control period: the measured state, then the motor
value chosen on it, its scores and reward. The last row, the end of the episode, has only the state.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.errors import RecordingError
from cartpole_rl.files import replacing
from cartpole_rl.physics.motor import LARGEST_MOTOR
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode

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
FEWEST_COUNTS, MOST_COUNTS = -(2**31), 2**31 - 1  # int32 on the wire
LENGTH = "pole_length_m"  # in the heading: twice pivot to centre of mass, empty if not known
GUARDED = "guarded"  # 1 where the track guard replaced the agent's motor value; empty without a guard
COLUMNS = (*STATE, *COUNTS, "motor", *STEP)  # that every recording has


def write_recording(path: Path, episode: Episode, facts: Mapping[str, Any] | None = None) -> None:
    """Write one episode atomically; `facts` are added to the heading."""
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        for key, value in {"format": FORMAT, "ended_by": episode.ended_by, **(facts or {})}.items():
            file.write(f"# {key}: {value}\n")
        lines = csv.writer(file)
        lines.writerow((*COLUMNS, GUARDED))
        for row in range(episode.steps + 1):
            state = [repr(float(getattr(episode, field)[row])) for field in STATE.values()]
            counts = [int(count) for count in episode.counts[row]]
            if row < episode.steps:
                step = [repr(float(getattr(episode, field)[row])) for field in STEP.values()]
                guarded = "" if episode.guarded is None else int(episode.guarded[row])
                lines.writerow([*state, *counts, int(episode.motor[row]), *step, guarded])
            else:
                lines.writerow([*state, *counts, "", *[""] * len(STEP), ""])


def read_recording(path: Path) -> Episode:
    """Read the episode in a file. Raises RecordingError if it is damaged or not a recording."""
    facts, text = {}, []
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("#"):
                key, _, value = line[1:].partition(":")
                facts[key.strip()] = value.strip()
            else:
                text.append(line)
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from None
    if facts.get("format") != FORMAT:
        raise RecordingError(f"{path} is not a recording: its first line is not '# format: {FORMAT}'")
    rows = list(csv.DictReader(text))
    if missing := [name for name in COLUMNS if not rows or name not in rows[0]]:
        raise RecordingError(f"{path} lacks {', '.join(missing)}")
    if len(rows) < 2:
        raise RecordingError(f"{path} holds no control period")
    if rows[-1]["motor"] != "":
        raise RecordingError(f"{path} is damaged: its last row is missing")
    try:
        ended_by = str(Ending(facts.get("ended_by", "")))
        columns: dict[str, Any] = {
            field: np.array([float(row[name]) for row in rows]) for name, field in STATE.items()
        }
        steps: dict[str, Any] = {
            field: np.array([float(row[name]) for row in rows[:-1]]) for name, field in STEP.items()
        }
        counts = np.array([[int(row[name]) for name in COUNTS] for row in rows])
        motor = np.array([int(row["motor"]) for row in rows[:-1]])
        marks = [row.get(GUARDED) for row in rows[:-1]]
        guarded = np.array([int(mark or 0) != 0 for mark in marks]) if any(marks) else None
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from None
    _check_numbers(path, {**columns, **steps}, motor, counts)
    return Episode(**columns, **steps, counts=counts, motor=motor, ended_by=ended_by, guarded=guarded)


def _check_numbers(
    path: Path, columns: Mapping[str, np.ndarray], motor: np.ndarray, counts: np.ndarray
) -> None:
    """Raise RecordingError for the first impossible number."""

    def damaged(row: int, what: str) -> RecordingError:
        return RecordingError(f"{path} is damaged: {what} in row {row + 1}; record it again, or leave it out")

    for name, values in columns.items():
        if not np.isfinite(values).all():
            raise damaged(int(np.flatnonzero(~np.isfinite(values))[0]), f"{name} is not finite")
    if not (steps := np.diff(columns["time"]) > 0).all():
        raise damaged(int(np.flatnonzero(~steps)[0]) + 1, "the time does not increase")
    if (beyond := (motor < -LARGEST_MOTOR) | (motor > LARGEST_MOTOR)).any():
        raise damaged(int(np.flatnonzero(beyond)[0]), f"a motor value is beyond {LARGEST_MOTOR}")
    if (beyond := (counts < FEWEST_COUNTS) | (counts > MOST_COUNTS)).any():
        raise damaged(int(np.flatnonzero(beyond.any(axis=1))[0]), f"a count is beyond {MOST_COUNTS}")
