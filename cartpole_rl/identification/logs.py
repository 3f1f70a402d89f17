"""Logs of other people's carts, read by a layout into episodes.

A layout says which columns a log has, their units and signs, which angle is upright, and whether the motor
value of a row was chosen on that row's state or was in force before it. A log is split where rows are missing
or left out, so that each part has a constant period. Rows with an empty cell, or with a number that is not
finite, are left out.
"""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError, reason_of
from cartpole_rl.identification.checks import shows_motion
from cartpole_rl.identification.experiments import recording
from cartpole_rl.identification.settings import Direction, Layout, TimeColumn
from cartpole_rl.identification.windows import UNEVEN, history_periods, mean_gap
from cartpole_rl.plants.measured import FASTEST_CART
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Encoders
from cartpole_rl.tasks.episode import Ending, Episode
from cartpole_rl.wire.messages import MOST_COUNTS

Array = NDArray[np.float64]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TURN = {"rad": 2 * np.pi, "deg": 360.0, "turn": 1.0}
LEAP, SMALL_LEAP = 0.25, 0.05  # turns beside whole ones between two rows; the latter where it is over a turn
FEW, LEAST_JUMPS = 50, 3  # values of a column that does not turn; jumps that tell where it wraps
MOST_OF_RANGE, ALIKE = 0.8, 0.02  # shares of a column's range, and of a jump by which others may differ
TURNING, STALE = 0.05 / (2 * np.pi), 1 / 3  # turns in three rows; share of such rows that repeat their states
NUMBERS = re.compile(r"(?=.*\d)([-+.,;:|\s\dEe]|nan|inf)+", re.IGNORECASE)  # a row of them
CLOCK = re.compile(r"\d+(:|[-/.]\d+[-/.]\d)")  # the beginning of a time of day or of a date
SLACK = 1e-6  # s, of sums of times
FINEST = 0.01  # share of the time between rows: with a shorter period a wrong unit would fill the memory
LONGEST_CELL = 40  # characters in a message
LONGEST_GAP, BRIDGED = 3, 1.5  # gaps, and periods, between rows: those further apart are not resampled
JUMPED, FLICKER = 0.75, 5  # share of a way that is made in one step; steps of a count that flickers
UNKNOWN, TWICE = "with an empty, missing or surplus cell, or no finite number", "that repeat the row before"
STALLED = "for which a stalled host read a later state"
SHORT, STANDING = "in a part that is too short", "in a part in which motor, cart or pole stand still"


class NotALogError(RecordingError):
    """A file that is no text, has fewer than two rows, or none of the columns that the layout names."""


class Report(NamedTuple):
    """The work done on one log."""

    rows: int
    left_out: Mapping[str, int]  # rows by reason
    gaps: int  # places where rows are missing
    saturated: int  # rows with full motor
    beyond: int  # rows with a motor value beyond full
    strongest: float  # the largest motor value as a share of full
    leaps: int  # rows to which no pole turns from the row before
    leap: str  # the first of them
    wrap: float  # turns by which the angle jumps where its column wraps; 0 if it does not
    anew: bool  # they are of one size, as where a counter begins anew
    jumps: int  # rows to which the cart would be faster than FASTEST_CART
    stale: float  # share of the rows of a turning pole that have the states of the row before
    period: float  # s
    gap: float  # s, the mean between rows, as `Rows.period`
    jitter: float  # s, 95 % of the gaps are within this of the period


class Rows(NamedTuple):
    """The rows of a file."""

    path: Path
    columns: dict[str, Array]  # [T] by name
    places: NDArray[np.int64]  # [T] in the file, from 1
    time: Array  # [T] s, from 0
    unknown: int  # further rows, with an empty cell or a number that is not finite
    repeated: int  # further rows, the same as the one before
    stalled: int  # further rows, for which a host that had stalled read a later state

    @property
    def period(self) -> float:
        """The mean gap between rows, s, of gaps that are near the median; to four digits."""
        return mean_gap(self.time)


class Log(NamedTuple):
    """The episodes of one log, the parts of which have a constant period."""

    parts: list[Episode]
    report: Report


def read_rows(path: Path, layout: Layout) -> Rows:
    """Return the rows of a log: text, or arrays by name in a .npz, .mat or .parquet file.

    Raises RecordingError, with file and row.
    """
    columns = read_columns(path, layout)
    known = np.logical_and.reduce([np.isfinite(values) for values in columns.values()])
    stamps = columns[layout.time.name]
    if layout.time.since == "previous_row" and known.any():
        unknown = 10 * np.nanmedian(stamps)  # rows are missing there
        stamps = np.cumsum(np.where(np.isfinite(stamps), stamps, unknown))
    columns, stamps = {name: values[known] for name, values in columns.items()}, stamps[known]
    fresh, compared = np.ones(known.sum(), bool), {**columns, layout.time.name: stamps}
    fresh[1:] = ~np.logical_and.reduce([values[1:] == values[:-1] for values in compared.values()])
    columns = {name: values[fresh] for name, values in columns.items()}
    late = stalled_rows(columns[layout.position.name], columns[layout.angle.name])
    columns = {name: values[~late] for name, values in columns.items()}
    if (~late).sum() < 2:
        raise NotALogError(f"{path} has fewer than two rows with a number in each of {', '.join(columns)}")
    places = np.flatnonzero(known)[fresh][~late] + 1
    time = times(path, stamps[fresh][~late], layout.time, places)
    return Rows(path, columns, places, time, int((~known).sum()), int((~fresh).sum()), int(late.sum()))


def stalled_rows(position: Array, angle: Array) -> NDArray[np.bool_]:
    """Return the rows [T] for which a host that had stalled read a later state.

    It makes up for the periods that it missed at once. So the state jumps along its motion, and stands in the
    next rows. Only the last of these rows has the state of its time.
    """
    steps = np.diff(np.stack((position, angle), 1), axis=0)  # from each row to the next
    edges = np.flatnonzero(np.diff(np.concatenate(([False], (steps == 0).all(1), [False])).astype(int)))
    moving = FLICKER * np.array([min(np.abs(each[each != 0]), default=0.0) for each in steps.T])
    stalled = np.zeros(len(position), bool)
    for first, last in edges.reshape(-1, 2):  # rows of one state, the last one included
        if first < 2 or last == len(steps):
            continue
        before, jump, after = steps[first - 2], steps[first - 1], steps[last]
        onwards = (before * jump > 0) & (after * jump > 0) & (np.abs(before) > moving)
        missed = (1 + last - first) * (before + after) / 2  # the way of its motion in these rows
        stalled[first:last] = (onwards & (np.abs(jump) > JUMPED * np.abs(missed))).any()
    return stalled


def cut_log(read: Rows, layout: Layout, encoders: Encoders, period: float) -> Log:
    """Return the episodes of a log with the control period `period`, s, in counts of `encoders`.

    Raises RecordingError, with file and row.
    """
    path, columns, time = read.path, read.columns, read.time
    if layout.resample and period < FINEST * read.period:
        raise RecordingError(
            f"{path}: its rows are {1e3 * read.period:g} ms apart, far more than a period of "
            f"{1e3 * period:g} ms: mend layout.time.unit or layout.period"
        )
    gaps = np.diff(time)
    jitter = float(np.quantile(np.abs(gaps - period), 0.95)) if len(gaps) else 0.0
    x = signed(layout.position.positive) * (columns[layout.position.name] - layout.position.zero)
    x *= METRES[layout.position.unit] if isinstance(layout.position.unit, str) else layout.position.unit
    turn = units_of_turn(layout)
    angle = columns[layout.angle.name]
    if not isinstance(layout.angle.wraps, bool):
        angle = np.unwrap(angle, period=layout.angle.wraps)
    theta = signed(layout.angle.positive) * (angle - layout.angle.upright) / turn
    motor = signed(layout.motor.positive) * columns[layout.motor.name] / layout.motor.full
    counted = np.ones(len(time), bool)
    left_out = {UNKNOWN: read.unknown, TWICE: read.repeated, STALLED: read.stalled}
    for name, (low, high) in layout.keep.items():
        bad = (columns[name] < low) | (columns[name] > high)
        left_out[f"{name} not in {low:g} to {high:g}"] = int((bad & counted).sum())
        counted &= ~bad
    if layout.resample:
        regular = gaps <= max(LONGEST_GAP * np.median(gaps), BRIDGED * period)
    else:
        regular = np.abs(gaps - period) <= UNEVEN * period
    together = counted[:-1] & counted[1:] & regular
    turned = np.abs(np.diff(theta))
    beside = np.abs((turned + 0.5) % 1 - 0.5)  # what is left of whole turns
    leaps = np.flatnonzero(together & ((beside > LEAP) | ((turned > 1 + LEAP) & (beside > SMALL_LEAP)))) + 1
    edges = np.flatnonzero(np.diff(np.concatenate(([False], together, [False]))))
    parts = []
    for first, last in edges.reshape(-1, 2):  # rows, the last one included
        rows = np.arange(first, last + 1)
        if time[last] - time[first] < layout.shortest - SLACK:
            left_out[SHORT] = left_out.get(SHORT, 0) + len(rows)
            continue
        turns = np.unwrap(theta[rows], period=1.0) if layout.angle.wraps else theta[rows]
        states = np.stack((x[rows] / encoders.metres, turns * encoders.turn), 1)
        if (beyond := np.abs(states) > MOST_COUNTS).any():
            place, column = np.argwhere(beyond)[0]
            name, row = (layout.position.name, layout.angle.name)[column], first + place
            raise RecordingError(
                f"{path}: {name} is {columns[name][row]:g} in row {read.places[row]}, which no "
                "encoder counts: correct it, or leave the row out by layout.keep"
            )
        late = int(layout.motor.row == "in_force")
        values = motor[rows[:-1] + late]
        steady = np.flatnonzero(~regular[:first])
        start, history = int(steady[-1]) + 1 if len(steady) else 0, history_periods(period)
        before = motor[max(first - history, start) + late : first + late]
        if layout.resample:
            states, values = resampled(time[rows], states, values, period)
            history = min(history, int((time[first] - time[start]) / period + SLACK))
            grid = time[first] - period * np.arange(history, -1, -1)
            before = averaged(time[start : first + 1], motor[start + late : first + late], grid)
        part = _episode(states, values, period, encoders, before)
        if shows_motion(part):
            parts.append(part)
        else:
            left_out[STANDING] = left_out.get(STANDING, 0) + len(rows)
    alone = ~np.concatenate(([False], together)) & ~np.concatenate((together, [False])) & counted
    left_out["alone between gaps"] = int(alone.sum())
    too_far = np.abs(np.diff(x)) > FASTEST_CART * np.maximum(gaps, period)  # stamps of a host are late
    report = Report(
        len(time) + read.unknown + read.repeated + read.stalled,
        {reason: number for reason, number in left_out.items() if number},
        int((~regular).sum()),
        int((np.abs(motor) >= 0.999).sum()),
        int((np.abs(motor) > 1.001).sum()),
        float(np.abs(motor).max()),
        len(leaps),
        f"row {read.places[leaps[0]]} of {path.name}" if len(leaps) else "",
        wrap_of(theta, together),
        len(leaps) > 0 and float(np.ptp(turned[leaps - 1])) < SMALL_LEAP,
        int(too_far.sum()),
        stale_share(x, theta),
        period,
        read.period,
        jitter,
    )
    return Log(parts, report)


def units_of_turn(layout: Layout) -> float:
    """Return how many units of the angle's column a turn has, by the layout."""
    unit = layout.angle.unit
    return TURN[unit] if isinstance(unit, str) else unit


def wrap_of(angle: Array, together: NDArray[np.bool_]) -> float:
    """Return the size of the jumps [T] where a column of angles wraps; 0 for one that does not.

    `together` [T - 1] are steps without a gap. A jump is over most of the column's range, larger than the
    steps beside it, and as large as the others.
    """
    if len(angle) < 4 or len(np.unique(angle)) < FEW:
        return 0.0
    step = np.diff(angle)
    calm = np.maximum(np.abs(step[:-2]), np.abs(step[2:]))
    size = np.abs(step[1:-1] - (step[:-2] + step[2:]) / 2)
    at_once = together[:-2] & together[1:-1] & together[2:]
    jumps = size[at_once & (size > 3 * calm) & (size > MOST_OF_RANGE * np.ptp(angle))]
    alike = len(jumps) >= LEAST_JUMPS and np.ptp(jumps) < 2 * ALIKE * np.median(jumps)
    return float(np.median(jumps)) if alike else 0.0


def stale_share(x: Array, theta: Array) -> float:
    """Return the share of rows of a turning pole, m and turns [T], that have the states of the row before."""
    turning = np.abs(theta[3:] - theta[:-3]) > TURNING
    stale = (np.diff(x) == 0) & (np.diff(theta) == 0)
    return float(stale[1:-1][turning].mean()) if turning.any() else 0.0


def signed(positive: Direction) -> int:
    """Return 1 for a column that increases to the right, -1 to the left."""
    return 1 if positive == "right" else -1


def read_columns(path: Path, layout: Layout) -> dict[str, Array]:
    """Return the columns of a log that the layout names. Raises RecordingError."""
    named = layout.time, layout.position, layout.angle, layout.motor
    wanted = [*dict.fromkeys((*(each.name for each in named), *layout.keep))]
    if read := ARRAYS.get(path.suffix.lower()):
        return array_columns(path, read, wanted)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        if isinstance(error, OSError):
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
        raise NotALogError(
            f"{path} cannot be read: it is not UTF-8 text; unpack it, or save it as UTF-8"
        ) from None
    (number, names), numbered = heading_and_rows(text, layout, wanted)
    if not numbered:
        raise NotALogError(f"{path} holds no rows; give a log with a line of column names")
    delimiter = layout.delimiter or found_delimiter(names, layout.decimal)
    heading = cells(path, number, names, delimiter)
    check_columns(path, wanted, heading)
    lines, rows = [number for number, _ in numbered], [cells(path, *each, delimiter) for each in numbered]
    longer = [place for place, row in enumerate(rows) if any(row[len(heading) :])]
    if 2 * len(longer) > len(lines):  # a few may end with a comment
        raise RecordingError(
            f"{path}, line {lines[longer[0]]}: it has {len(rows[longer[0]])} cells under {len(heading)} "
            "names; mend decimal= and delimiter= of the layout"
        )
    usual = int(np.median([len(row) for row in rows]))
    for row in rows:  # bytes were lost, so its cells may belong to other columns
        if len(row) < usual or any(map(NUMBERS.fullmatch, row[len(heading) :])):
            row.clear()
    return {name: _numbers(path, name, heading.index(name), rows, lines, layout) for name in wanted}


def heading_and_rows(
    text: str, layout: Layout, wanted: Sequence[str]
) -> tuple[tuple[int, str], list[tuple[int, str]]]:
    """Return the line of column names, and the rows, with their line numbers.

    NumPy writes the names as the last comment before the numbers.
    """
    numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    marked = [line.lstrip().startswith(layout.comment) for _, line in numbered]
    first = marked.index(False) if False in marked else len(marked)
    rows = [each for each, comment in zip(numbered, marked, strict=True) if not comment]
    if 0 < first < len(marked) and NUMBERS.fullmatch(rows[0][1]):
        number, names = numbered[first - 1]
        names = re.sub(r"^ *[#%] *", "", names.lstrip().removeprefix(layout.comment))
        if all(name in names for name in wanted):
            return (number, names), rows
    number, names = rows.pop(0) if rows else (0, "")
    if not any(name.startswith(("#", "%")) for name in wanted):
        names = re.sub(r"^ *[#%] *", "", names)
    return (number, names), rows


def check_columns(path: Path, wanted: Sequence[str], present: Sequence[str]) -> None:
    """Raise RecordingError for a wanted column that is not present, or present twice."""
    if twice := [name for name in wanted if list(present).count(name) > 1]:
        raise RecordingError(f"{path} has several columns {', '.join(twice)}; give each a name of its own")
    if missing := [name for name in wanted if name not in present]:
        kind = NotALogError if len(missing) == len(wanted) else RecordingError
        raise kind(f"{path} has no column {', '.join(missing)}; it has {', '.join(present)}")


def read_npz(path: Path) -> Mapping[str, NDArray]:
    """Return the arrays of an .npz file."""
    try:
        with np.load(path) as file:
            return dict(file)
    except ValueError:  # NumPy takes it for a pickle
        raise ValueError("it is damaged, or holds other than arrays of numbers") from None


def read_mat(path: Path) -> Mapping[str, NDArray]:
    """Return the variables of a .mat file, up to version 7."""
    from scipy.io import loadmat  # slow to import

    try:
        return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    except NotImplementedError:
        raise ValueError("it is of version 7.3; save it with -v7") from None


def read_parquet(path: Path) -> Mapping[str, NDArray]:
    """Return the columns of a Parquet file."""
    try:
        from pyarrow import parquet
    except ImportError:
        raise ValueError('this needs PyArrow: pip install "cartpole_rl[parquet]"') from None
    file = parquet.read_table(path)
    return {name: file[name].to_numpy() for name in file.column_names}


ARRAYS: dict[str, Callable[[Path], Mapping[str, NDArray]]] = {
    ".npz": read_npz,
    ".mat": read_mat,
    ".parquet": read_parquet,
}


def array_columns(
    path: Path, read: Callable[[Path], Mapping[str, NDArray]], wanted: Sequence[str]
) -> dict[str, Array]:
    """Return the wanted columns of a file of arrays. Raises RecordingError."""
    try:
        present = read(path)
    except Exception as error:  # the libraries have many for a damaged file
        raise RecordingError(f"{path} cannot be read: {reason_of(error)}") from None
    check_columns(path, wanted, [*present])
    columns = {}
    for name in wanted:
        column = np.atleast_1d(np.squeeze(present[name]))
        if column.ndim != 1 or column.dtype.kind not in "fiub":
            raise RecordingError(f"{path}: {name} is no column of numbers")
        columns[name] = column.astype(float)
    sizes = {name: len(column) for name, column in columns.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise RecordingError(f"{path}: columns need the same number of rows; rows: {listed}")
    return columns


def cells(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without blanks around them. Raises RecordingError."""
    if delimiter == " " and '"' not in line:  # as in a table that is aligned by blanks
        return line.split()
    try:
        (row,) = csv.reader([line.strip(" ")], delimiter=delimiter, skipinitialspace=True)
    except (csv.Error, ValueError):
        raise RecordingError(f"{path}, line {number}: it is no row of cells; leave the line out") from None
    return [cell.strip() for cell in row]


def found_delimiter(heading: str, decimal: str) -> str:
    """Return the delimiter that occurs most often in the line of column names."""
    candidates = [each for each in ",;\t|" if each != decimal] if decimal == "," else [*",;\t|"]
    best = max(candidates, key=heading.count)
    return best if best in heading else " "


def _numbers(
    path: Path, name: str, column: int, rows: Sequence[Sequence[str]], lines: Sequence[int], layout: Layout
) -> Array:
    values = np.empty(len(rows))
    for index, (row, line) in enumerate(zip(rows, lines, strict=True)):
        cell = row[column] if column < len(row) else ""
        try:
            if "_" in cell or (layout.decimal == "," and "." in cell):  # of thousands
                raise ValueError
            values[index] = float(cell.replace(layout.decimal, ".") or "nan")
        except ValueError:
            shown = cell if len(cell) <= LONGEST_CELL else f"{cell[:LONGEST_CELL]}..."
            if CLOCK.match(cell):
                advice = f" in {layout.time.unit}" if name == layout.time.name else ""
            elif NUMBERS.fullmatch(cell):
                advice = ", or mend decimal= and delimiter= of the layout"
            else:
                advice = f", leave the cell empty, or begin the line with {layout.comment}"
            raise RecordingError(f"{path}, line {line}: {name} is {shown!r}; give a number{advice}") from None
    return values


def times(path: Path, values: Array, column: TimeColumn, places: NDArray[np.int64]) -> Array:
    """Return the time of each row in s, from 0, for values that count from a start; `places` are its rows.

    Raises RecordingError.
    """
    time = (values - values[0]) * SECONDS[column.unit]
    if (back := np.flatnonzero(np.diff(time) <= 0)).size:
        before, after = time[back[0] : back[0] + 2]
        row, following = places[back[0] : back[0] + 2]
        if before == after:
            raise RecordingError(
                f"{path}: the time {column.name} is {values[back[0]]:.9g} in rows {row} and "
                f"{following}; write it with more digits, or leave one of the rows out"
            )
        raise RecordingError(
            f"{path}: the time {column.name} goes from {before:.6g} to {after:.6g} s after row {row}; "
            "sort the rows, give another column, or cut the log where the clock began anew"
        )
    return time


def resampled(time: Array, states: Array, motor: Array, period: float) -> tuple[Array, Array]:
    """Return states [T + 1, 2] and motor values [T] at a constant period.

    States lie on lines between the rows; a motor value is the mean of those in force in its period.
    """
    grid = np.arange(time[0], time[-1] + 1e-9, period)
    at = np.stack([np.interp(grid, time, column) for column in states.T], 1)
    return at, averaged(time, motor, grid)


def averaged(time: Array, motor: Array, grid: Array) -> Array:
    """Return the means of motor values [T], between `time` [T + 1], in each period of `grid` [K + 1]."""
    total = np.concatenate((np.zeros(1), np.cumsum(motor * np.diff(time))))
    return np.diff(np.interp(grid, time, total)) / np.diff(grid)


def _episode(states: Array, motor: Array, period: float, encoders: Encoders, before: Array) -> Episode:
    motors, earlier = (
        np.clip(np.rint(each * LARGEST_MOTOR), -LARGEST_MOTOR, LARGEST_MOTOR).astype(np.int64)
        for each in (motor, before)
    )
    gaps, counts = np.full(len(motors), period), np.rint(states).astype(np.int64)
    part = recording(counts, gaps, motors, str(Ending.TIME), encoders)
    return replace(part, motor_before=tuple(earlier.tolist()))
