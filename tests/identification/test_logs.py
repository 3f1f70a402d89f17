"""Logs of others in every shape that people write, and what motion says of their columns."""

import importlib
import re
import textwrap
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import in_process
from scipy.io import savemat

from cartpole_rl.checking import validated
from cartpole_rl.choices import choice, conf_folder
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.identification.checks import check_directions, check_recordings, shared_period
from cartpole_rl.identification.experiments import recording
from cartpole_rl.identification.logs import Log, cut_log, read_rows
from cartpole_rl.identification.sensors import Motion, question_sensors
from cartpole_rl.identification.settings import ImportConfig, Layout
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.run_folder import experiments
from cartpole_rl.tasks.episode import Episode, wrap
from cartpole_rl.workflows.import_logs import import_logs

PERIOD, STEPS, LENGTH = 0.02, 1500, 0.3  # s; length of the equivalent simple pendulum, m
LAYOUT: dict[str, Any] = {
    "time": {"name": "t"},
    "position": {"name": "x"},
    "angle": {"name": "a"},
    "motor": {"name": "u", "full": 255},
}
Columns = dict[str, np.ndarray]
Read, Doubts = Callable[..., Log], Callable[..., list[str]]  # the fixtures `read` and `doubts`
ENCODERS = nominal_encoders()
GAINS = np.array((820.0, 1218.0, 460.0, 213.0))  # of x, theta and their rates: poles at -2, -2.5, -5, -6


@pytest.fixture(scope="module")
def motion() -> Columns:
    return driven_pole(255)


@pytest.fixture(scope="module")
def swings() -> Columns:
    return driven_pole(100)


def driven_pole(most: int, late: int = 10, balanced: bool = False) -> Columns:
    """A swinging pole on a driven cart, by equation (3.6), in steps of 1 ms; the motor is `late` ms late.

    With `balanced` the motor keeps the pole upright.
    """
    dice, fine = np.random.default_rng(3), 20
    motor = np.repeat(dice.integers(-most, most + 1, STEPS // 6), 6).astype(float)
    step = PERIOD / fine
    x, x_dot, theta, theta_dot, rows = 0.0, 0.0, np.pi, 0.5, []
    if balanced:
        theta, theta_dot, before = 0.0, 0.1, np.zeros(2)
    for index in range(STEPS * fine):
        if index % fine == 0:
            rows.append((x, theta))
            if balanced:
                seen = np.rint((x / ENCODERS.metres, theta / ENCODERS.radians)) * ENCODERS.resolution
                speeds, before = (seen - before) / PERIOD, seen
                motor[index // fine] = round(GAINS @ (*seen, *speeds))
        push = motor[max(0, index - late) // fine]
        x_ddot = 0.03 * push - 8 * x_dot - 20 * x
        theta_ddot = (9.81 * np.sin(theta) - x_ddot * np.cos(theta)) / LENGTH - 0.1 * theta_dot
        x_dot, theta_dot = x_dot + step * x_ddot, theta_dot + step * theta_ddot
        x, theta = x + step * x_dot, theta + step * theta_dot
    positions = np.array(rows)
    return {"t": PERIOD * np.arange(STEPS), "x": positions[:, 0], "a": positions[:, 1], "u": motor}


@pytest.fixture(scope="module")
def balanced() -> Columns:
    """A pole within 0.2 rad of upright, by the same equation, under feedback and random pushes."""
    fine, gains = 20, np.array((400, 800, 2200, 400))
    pushes = np.repeat(np.random.default_rng(5).integers(-100, 101, STEPS // 25), 25)
    state, step, motor, rows = np.array((0, 0, 0.1, 0)), PERIOD / fine, [], []
    for index in range(STEPS):
        rows.append(state[[0, 2]])
        motor.append(float(np.clip(np.rint(gains @ state) + pushes[index], -255, 255)))
        for _ in range(fine):
            x, x_dot, theta, theta_dot = state
            x_ddot = 0.03 * motor[index] - 8 * x_dot
            theta_ddot = (9.81 * np.sin(theta) - x_ddot * np.cos(theta)) / LENGTH - 0.1 * theta_dot
            state = state + step * np.array((x_dot, x_ddot, theta_dot, theta_ddot))
    x, theta = np.array(rows).T
    return {"t": PERIOD * np.arange(STEPS), "x": x, "a": theta, "u": np.array(motor)}


def written(
    path: Path,
    columns: Columns,
    delimiter: str = ",",
    decimal: str = ".",
    head: str = "",
    row: str = "{:.9g}",
) -> Path:
    lines = [delimiter.join(columns)]
    for values in zip(*columns.values(), strict=True):
        lines.append(delimiter.join(row.format(each).replace(".", decimal) for each in values))
    path.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def layout(**changes: Any) -> Layout:
    """The layout above; a mapping changes a column, anything else takes its place."""
    values = {
        name: {**LAYOUT.get(name, {}), **change} if isinstance(change, dict) and name in LAYOUT else change
        for name, change in changes.items()
    }
    return validated(Layout, {**LAYOUT, **values})


def read_log(path: Path, **changes: Any) -> Log:
    """The log of a file, by the layout with these changes."""
    taken = layout(**changes)
    rows = read_rows(path, taken)
    return cut_log(rows, taken, ENCODERS, taken.period or rows.period)


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Log]:
    """The log of columns that are written in a `style`, by the layout with these changes."""
    return lambda columns, style={}, **changes: read_log(
        written(tmp_path / "log.csv", columns, **style), **changes
    )


def imported(source: Path, **changes: Any) -> ImportConfig:
    values = {"from": source, "layout": layout(**changes), "cart": choice("cart/ip02"), "label": ""}
    return validated(ImportConfig, values)


@pytest.fixture
def doubts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., list[str]]:
    """Import columns by the layout with these changes; return the doubts."""

    def found(columns: Columns, **changes: Any) -> list[str]:
        import_logs(imported(written(tmp_path / "log.csv", columns), **changes), tmp_path / "run")
        return re.findall("doubt: (.*)", capsys.readouterr().out)

    return found


@pytest.mark.parametrize(
    ("style", "changes"),
    [
        ({}, {}),
        ({"delimiter": ";", "decimal": ","}, {"decimal": ","}),
        ({"delimiter": "\t", "head": "\ufeff# made by hand\n# second line\n"}, {}),
        ({"delimiter": " "}, {}),
        ({"delimiter": "\t"}, {"delimiter": r"\t"}),  # as a shell gives it
        ({"head": "% written by MATLAB\n\n"}, {"comment": "%"}),
        ({"delimiter": " ", "row": "{:16.9g}"}, {}),
        ({"delimiter": " ", "head": "# of Monday\n# "}, {}),  # numpy.savetxt(header=...)
        ({"delimiter": "\t", "head": "# "}, {"comment": "%"}),
        ({"head": "//"}, {"comment": "//"}),
    ],
)
def test_a_log_is_read_in_every_style(
    read: Read, motion: Columns, style: dict[str, str], changes: dict[str, Any]
) -> None:
    (part,) = read(motion, style, **changes).parts
    assert part.steps == STEPS - 1
    assert part.x == pytest.approx(motion["x"], abs=2e-5)
    assert part.theta == pytest.approx(motion["a"], abs=1e-3)
    assert part.motor.tolist() == motion["u"][:-1].tolist()


def test_an_empty_first_cell_shifts_no_row(tmp_path: Path, motion: Columns) -> None:
    """As where pandas writes an index without a name, or the clock of a row is missing."""
    text = written(tmp_path / "log.csv", {"": np.arange(STEPS), **motion}, "\t").read_text()
    (part,) = read_log(tmp_path / "log.csv").parts
    assert part.x == pytest.approx(motion["x"], abs=2e-5)
    lines = [line.partition("\t")[2] for line in text.splitlines()]
    lines[500] = lines[500][lines[500].index("\t") :]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    log = read_log(tmp_path / "log.csv")
    assert log.report.left_out == {"with an empty, missing or surplus cell, or no finite number": 1}


def parquet(path: Path, columns: Columns) -> None:
    arrow = pytest.importorskip("pyarrow", reason="it is an extra")
    importlib.import_module("pyarrow.parquet").write_table(arrow.table(columns), path)


ARRAYS: dict[str, Callable[[Path, Columns], None]] = {
    "npz": lambda path, columns: np.savez(path, **columns),
    "mat": savemat,
    "parquet": parquet,
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_a_log_of_arrays_is_as_one_of_text(tmp_path: Path, read: Read, motion: Columns, kind: str) -> None:
    text = read(motion, {"row": "{:.17g}"})
    ARRAYS[kind](tmp_path / f"log.{kind}", motion)
    log = read_log(tmp_path / f"log.{kind}")
    (part,), (other,) = log.parts, text.parts
    assert (log.report, part.counts.tolist(), part.motor.tolist()) == (
        text.report,
        other.counts.tolist(),
        other.motor.tolist(),
    )
    path = tmp_path / f"bad.{kind}"
    lacking = {name: motion[name] for name in "txu"}
    unknown = {**motion, "x": np.where(np.arange(STEPS) == 2, np.nan, motion["x"])}
    ARRAYS[kind](path, unknown)
    assert read_log(path).report.left_out == {
        "with an empty, missing or surplus cell, or no finite number": 1,
        "in a part that is too short": 2,
    }
    ARRAYS[kind](path, lacking)
    with pytest.raises(RecordingError, match=re.escape(f"{path} has no column a; it has t, x, u")):
        read_log(path, keep={"a": [-9, 9]})  # named once
    path.write_bytes(b"neither")
    with pytest.raises(RecordingError, match="cannot be read: "):
        read_log(path)


@pytest.mark.parametrize(
    ("convert", "changes"),
    [
        (lambda each: {"t": 1e6 * each["t"]}, {"time": {"unit": "us"}}),
        (lambda each: {"t": np.full(STEPS, 20.0)}, {"time": {"unit": "ms", "since": "previous_row"}}),
        (
            lambda each: {"x": -1e3 * each["x"] + 7},
            {"position": {"unit": "mm", "positive": "left", "zero": 7}},
        ),
        (lambda each: {"x": each["x"] / 5e-5}, {"position": {"unit": 5e-5}}),
        (lambda each: {"a": np.degrees(each["a"])}, {"angle": {"unit": "deg"}}),
        (
            lambda each: {"a": (1000 - each["a"] / (2 * np.pi) * 4271) % 4271},
            {"angle": {"unit": 4271, "positive": "left", "upright": 1000}},
        ),
        (lambda each: {"a": each["a"] % 4}, {"angle": {"wraps": 4}}),
        (lambda each: {"u": -each["u"] / 255}, {"motor": {"full": 1, "positive": "left"}}),
        (lambda each: {"u": np.roll(each["u"], 1)}, {"motor": {"row": "in_force"}}),
    ],
)
def test_units_and_signs(
    read: Read, motion: Columns, convert: Callable[[Columns], Columns], changes: dict[str, Any]
) -> None:
    (part,) = read({**motion, **convert(motion)}, **changes).parts
    assert part.x == pytest.approx(motion["x"], abs=3e-5)
    turns = (part.theta - motion["a"]) / (2 * np.pi)
    assert turns == pytest.approx(np.full(STEPS, round(turns[0])), abs=3e-4)
    assert part.motor.tolist() == motion["u"][:-1].tolist()
    assert np.diff(part.time) == pytest.approx(PERIOD)


def test_a_log_is_split_where_rows_are_missing_or_left_out(read: Read, motion: Columns) -> None:
    kept = np.delete(np.arange(STEPS), [300, 301])
    columns = {**{name: values[kept] for name, values in motion.items()}, "bad": np.zeros(len(kept))}
    columns["bad"][[600, 650]] = 1
    log = read(columns, keep={"bad": [0, 0]})
    assert [part.steps for part in log.parts] == [299, 299, STEPS - 654]
    assert log.report.gaps == 1
    assert log.report.left_out == {"bad not in 0 to 0": 2, "in a part that is too short": 49}


@pytest.mark.parametrize("since", ["start", "previous_row"])
def test_rows_without_a_number_and_repeated_ones_are_left_out(
    tmp_path: Path, motion: Columns, since: str
) -> None:
    columns = {name: values.copy() for name, values in motion.items()}
    columns["a"][400], columns["u"][900] = np.nan, np.inf
    if since == "previous_row":
        columns["t"] = np.diff(motion["t"], prepend=-PERIOD)
        columns["t"][700] = np.nan
    path = written(tmp_path / "log.csv", columns)
    lines = path.read_text().replace("nan", "").splitlines()
    if since == "start":
        lines.insert(700, lines[700])
    path.write_text("\n".join((*lines, "12.3,0.")))  # the power failed
    log = read_log(path, time={"since": since})
    assert [part.steps for part in log.parts] == [399, *([498] if since == "start" else [298, 198]), 598]
    unknown = "with an empty, missing or surplus cell, or no finite number"
    expected = {unknown: 4} if since == "previous_row" else {unknown: 3, "that repeat the row before": 1}
    assert log.report.left_out == expected


@pytest.mark.parametrize("resample", [False, True])
def test_rows_for_which_a_stalled_host_read_a_later_state_are_left_out(
    read: Read, motion: Columns, resample: bool
) -> None:
    """Such a host reads one state for all rows that it missed; the last of them has the state of its time."""
    columns = {name: values.copy() for name, values in motion.items()}
    stalled = [slice(400, 402), slice(700, 701)]
    for rows in stalled:
        for name in ("x", "a"):
            columns[name][rows] = columns[name][rows.stop]
    log = read(columns, resample=resample)
    assert log.report.left_out == {"for which a stalled host read a later state": 3}
    assert [part.steps for part in log.parts] == ([STEPS - 1] if resample else [399, 297, STEPS - 702])
    if resample:  # on lines between the rows
        assert np.abs(wrap(log.parts[0].theta - motion["a"])).max() < 0.1
    standing = {**columns, "a": np.round(columns["a"], 1)}  # too coarse: it stands between its counts
    standing["x"] = np.round(columns["x"], 2)
    assert not read(standing, resample=resample).report.left_out


def test_the_time_since_the_row_before_can_be_kept_within_bounds(read: Read, motion: Columns) -> None:
    """A standing cart and a constant gap are no repeated row."""
    columns = {name: np.concatenate((values, np.full(100, values[-1]))) for name, values in motion.items()}
    columns["t"] = np.full(STEPS + 100, PERIOD)
    columns["t"][500] = 0.023
    log = read(columns, time={"since": "previous_row"}, keep={"t": [0.019, 0.021]})
    assert [part.steps for part in log.parts] == [499, STEPS + 98 - 500]
    assert log.report.left_out == {"t not in 0.019 to 0.021": 1}


@pytest.mark.parametrize(("row", "shift"), [("chosen", 0), ("in_force", 1)])
def test_a_part_knows_the_motor_values_before_it(
    tmp_path: Path, motion: Columns, row: str, shift: int
) -> None:
    columns = {**motion, "ok": np.ones(STEPS)}
    columns["ok"][[500, 800]] = 0
    columns["t"] = motion["t"] + np.where(np.arange(STEPS) > 796, 0.1, 0.0)  # 100 ms are missing
    path = written(tmp_path / "log.csv", columns)
    changes = {"keep": {"ok": [1, 1]}, "motor": {"row": row}}
    first, *others = read_log(path, **changes).parts
    assert first.motor_before == ()
    again = read_log(path, **changes, resample=True).parts
    assert [part.motor_before for part in again] == [(), *(part.motor_before for part in others)]
    values = motion["u"].astype(int).tolist()
    before = {part.motor_before for part in others}
    assert tuple(values[489 + shift : 501 + shift]) in before  # 0.24 s
    assert tuple(values[797 + shift : 801 + shift]) in before  # since the gap
    write_recording(tmp_path / "part.csv", others[0])
    assert read_recording(tmp_path / "part.csv").episode.motor_before == others[0].motor_before
    windows = cut_windows(others[:1], PERIOD)
    history = windows.motors.shape[0] - windows.periods
    assert windows.motors[:history, 0].tolist() == [*others[0].motor_before][-history:]


def test_a_log_with_a_varying_period_is_resampled(read: Read, motion: Columns) -> None:
    dice = np.random.default_rng(1)
    times = motion["t"] + dice.uniform(-0.006, 0.006, STEPS)
    columns = {name: np.interp(times, motion["t"], values) for name, values in motion.items() if name != "u"}
    log = read({**columns, "t": times, "u": motion["u"]}, resample=True, period=PERIOD)
    (part,) = log.parts
    assert log.report.jitter > 0.004
    assert part.x == pytest.approx(np.interp(part.time + times[0], motion["t"], motion["x"]), abs=2e-3)


def test_a_resampled_log_is_still_split_where_rows_are_missing(read: Read, motion: Columns) -> None:
    columns = {name: np.delete(values, np.arange(400, 550)) for name, values in motion.items()}
    log = read(columns, resample=True, period=0.05)
    assert log.report.gaps == 1
    assert [part.steps for part in log.parts] == [159, 379]


@pytest.mark.parametrize(("period", "uneven"), [(10, 2), (5, 1)])
def test_stamps_in_whole_milliseconds_do_not_split_a_log(
    read: Read, motion: Columns, period: int, uneven: int
) -> None:
    """Gaps a fifth too long or too short, whatever they are after rounding."""
    gaps = np.full(STEPS, period)
    gaps[5::20], gaps[6::20] = period - uneven, period + uneven
    log = read({**motion, "t": gaps.cumsum() / 1e3})
    assert [part.steps for part in log.parts] == [STEPS - 1]
    assert log.report.period == period / 1e3


@pytest.mark.parametrize(("period", "steps"), [(0.1, [80, 80]), (0.005, [1596, 1596])])
def test_the_shortest_part_is_in_seconds_also_where_rows_are_resampled(
    read: Read, motion: Columns, period: float, steps: list[int]
) -> None:
    kept = [*range(400), *range(420, 470), *range(500, 900)]  # 8, 1 and 8 s
    columns = {name: values[kept] for name, values in motion.items()}
    log = read(columns, resample=True, period=period)
    assert [part.steps for part in log.parts] == pytest.approx(steps, abs=1)


def test_a_wrong_period_is_not_blamed_on_the_clock(doubts: Doubts, motion: Columns) -> None:
    with pytest.raises(RecordingError, match=r"; rows are 20 ms apart, not layout.period=0.04 s: leave it"):
        doubts(motion, period=0.04)


@pytest.mark.parametrize(
    ("rate", "period", "said"),
    [
        (50, 0.0192, "rows are 20 ms apart, not layout.period=0.0192 s: leave it out, or give"),
        (50, 0.0201, ""),
        (60, 1 / 60, ""),  # the median is 17 ms
    ],
)
def test_a_period_that_the_rows_contradict_is_a_doubt(
    doubts: Doubts, motion: Columns, rate: float, period: float, said: str
) -> None:
    """The recordings of a wrong period would have other accelerations than the log."""
    columns = {**motion, "t": np.round(np.arange(STEPS) / rate, 3)}
    of_rows = [each for each in doubts(columns, period=period) if each.startswith("rows")]
    assert [each.startswith(said) for each in of_rows] == [True] * bool(said)


@pytest.mark.parametrize("period", [40, 20])
def test_a_period_beyond_all_is_blamed(doubts: Doubts, motion: Columns, period: float) -> None:
    """Longer than the log, and shorter."""
    said = f"stand still; layout.period={period} s: give 0.005 to 0.1, or leave it out"
    with pytest.raises(RecordingError, match=re.escape(said)):
        doubts(motion, period=period, resample=True)


@pytest.mark.parametrize(("period", "doubted"), [(0.005, True), (0.018, False)])
def test_rows_are_not_invented_without_a_doubt(
    doubts: Doubts, motion: Columns, period: float, doubted: bool
) -> None:
    said = f"layout.period={period} s is shorter than the 20 ms between rows"
    assert doubted == any(each.startswith(said) for each in doubts(motion, period=period, resample=True))


def test_the_period_is_the_mean_gap(read: Read, motion: Columns) -> None:
    """60 Hz with stamps in whole milliseconds: the median gap is 17 ms."""
    log = read({**motion, "t": np.round(np.arange(STEPS) / 60, 3)})
    assert log.report.period == shared_period({"log.csv": log.parts[0]}) == 0.01667
    assert len(log.parts) == 1


def test_the_period_of_recordings_is_not_that_of_the_first(read: Read, motion: Columns) -> None:
    gaps = {"slower": 0.0203, "one": 0.02, "other": 0.02}
    parts = {name: read({**motion, "t": gap * np.arange(STEPS)}).parts[0] for name, gap in gaps.items()}
    assert shared_period(parts) == 0.02


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no rows"),
        ("t,x,a,u\n", "holds no rows; give a log with a line of column names"),
        ("t,x,a,u\n0,0,0,0\n", "fewer than two rows with a number in each of t, x, a, u"),
        ("t,x,x,a,u\n0,0,0,0,0\n1,1,1,1,1\n", "has several columns x; give each a name of its own"),
        ("t,x,a\n0,0,0\n1,1,1\n", r"has no column u; it has t, x, a"),
        ("t,x,a,u\n0,0,0,0\n1,0,,0\n2,0,nan,0\n", "fewer than two rows with a number in each of t, x, a, u"),
        ("t,x,a,u\n0,0,0,0\n1,0,two,0\n", "line 3: a is 'two'"),
        (
            "t,x,a,u\n0,0,0,0,0,0,0,0\n0,1,0,1,0,1,0,1\n",
            "line 2: it has 8 cells under 4 names; mend decimal=",
        ),
        ('t,x,a,u\n0,0,0,"0\n1,0,two,0\n', "line 3: a is 'two'"),
        (
            "t,x,a,u\ns,m,rad,V\n0,0,0,0\n1,0,0,0\n",
            "line 2: t is 's'; give a number, leave the cell empty, or begin the line with #$",
        ),
        ("t,x,a,u\n12:00:00.5,0,0,0\n", r"line 2: t is '12:00:00\.5'; give a number in s$"),
        ("t,x,a,u\n2026-12-01T12:00,0,0,0\n", "line 2: t is '2026-12-01T12:00'; give a number in s$"),
        ("t,x,a,u\n1.12.2026,0,0,0\n", r"line 2: t is '1\.12\.2026'; give a number in s$"),
        ("t;x;a;u\n0;0,5;0;0\n", "line 2: x is '0,5'; give a number, or mend decimal= and delimiter="),
        (
            "t,x,a,u\n0,0,0,0\n0.1,0,0,0\n0.1,1,0,0\n",
            r"the time t is 0\.1 in rows 2 and 3; write it with more digits, or leave one of the rows out",
        ),
        ("t,x,a,u\n0,,0,0\n1,0,0,0\n1,1,0,0\n", "the time t is 1 in rows 2 and 3"),
        ("t,x,a,u\n0,0,0,1_0\n", "line 2: u is '1_0'"),
        (f"t,x,a,u\n0,0,0,{'-' * 50}\n", f"line 2: u is '{'-' * 40}...'"),
        ("t,x,a,u\n0,0,0,0\n9,0,0,0\n1,0,0,0\n", "the time t goes from 9 to 1 s after row 2; sort the rows"),
    ],
)
def test_a_bad_log_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_log(path)


@pytest.mark.parametrize("damaged", ["1.98,0.1,50,7", "1.98,0.0,2,0.1,3.6,98,7"])
def test_a_line_with_a_lost_or_a_surplus_number_shifts_no_column(
    tmp_path: Path, motion: Columns, damaged: str
) -> None:
    path = written(tmp_path / "log.csv", {**motion, "i": motion["u"]})
    lines = path.read_text().splitlines()
    lines[100] = damaged  # as where a serial line lost bytes
    path.write_text("\n".join(lines))
    assert [part.steps for part in read_log(path).parts] == [98, 1399]


def test_a_point_is_no_decimal_where_a_comma_is(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t;x;a;u\n0;0,5;0;-2.583\n")
    with pytest.raises(RecordingError, match=r"line 2: u is '-2\.583'; give a number, or mend decimal="):
        read_log(tmp_path / "log.csv", decimal=",")


def test_a_wrong_unit_of_the_time_invents_no_rows(read: Read, motion: Columns) -> None:
    with pytest.raises(RecordingError, match=r"log\.csv: its rows are 2e\+07 ms apart, .* mend layout\.time"):
        read({**motion, "t": 1e6 * motion["t"]}, resample=True, period=0.02)


def test_a_late_stamp_is_no_fast_cart(read: Read, motion: Columns) -> None:
    """The row after it seems to come at once."""
    time = motion["t"].copy()
    time[400] += 0.9999 * PERIOD
    log = read({**motion, "t": time}, resample=True)
    assert np.abs(np.diff(motion["x"]))[400] > 5 * np.diff(time)[400]
    assert log.report.jumps == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keep": {"bad": [1, 0]}}, r"give the lower bound first, as \[0,1\]"),
        (
            {"angle": {"unit": "degrees"}},
            r"^angle\.unit=degrees: did you mean deg\? give 'rad', .*, or a number$",
        ),
        ({"angle": {"wraps": "maybe"}}, r"^angle\.wraps=maybe: give true or false, or a number$"),
        ({"keep": {"bad": 0}}, r"^keep\.bad=0: give the lowest and the highest value, as \[0,0\.5\]$"),
        ({"motor": {"full": 0}}, "motor.full=0"),
        ({"angle": {"name": "x"}}, "angle.name=x: position.name is the same; give each its own column"),
    ],
)
def test_a_bad_layout_is_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        layout(**changes)


def test_sensors_are_known_from_motion(motion: Columns) -> None:
    """A scale of the angle 4 % wrong, a zero 2 degrees wrong, and a position 10 % too large."""
    recorded = Motion(1.1 * motion["x"], motion["a"] / 0.96 + np.radians(2), motion["u"][:-1])
    sensors = question_sensors([recorded], PERIOD)
    assert sensors.angle_scale is not None
    assert sensors.angle_scale.value == pytest.approx(0.96, abs=0.004)
    assert sensors.position_scale is not None
    assert sensors.position_scale.value == pytest.approx(1 / 1.1, rel=0.03)
    assert sensors.delay is not None
    assert sensors.delay.value == pytest.approx(0.01, abs=0.002)


def test_the_intervals_of_a_swinging_pole_hold_the_truth(swings: Columns) -> None:
    """The pole never goes over the top; the filters of both sides of the equation have to be the same."""
    sensors = question_sensors([Motion(swings["x"], swings["a"], swings["u"][:-1])], PERIOD)
    assert np.abs(swings["a"] - np.pi).max() < 3
    for estimate, truth, margin in (
        (sensors.angle_scale, 1, 2e-3),
        (sensors.angle_zero, 0, 4e-3),
        (sensors.position_scale, 1, 2e-3),
        (sensors.delay, 0.0095, 1e-3),  # this integration lets a force act half a step early
    ):
        assert estimate is not None
        assert estimate.holds(truth, margin), estimate
        assert estimate.high - estimate.low < 5 * margin


def recorded(motion: Columns) -> Episode:
    counts = np.rint(np.stack((motion["x"] / ENCODERS.metres, motion["a"] / ENCODERS.radians), 1))
    motor = motion["u"][:-1].astype(np.int64)
    return recording(counts, np.full(STEPS - 1, PERIOD), motor, "time", ENCODERS)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [("u", "push the cart towards smaller counts"), ("a", "the pole runs ahead"), ("", "")],
)
def test_the_signs_of_a_pole_that_is_only_balanced_are_known(wrong: str, message: str) -> None:
    """The motor follows the pole there, so that its values and the cart's acceleration hardly correlate."""
    columns = driven_pole(0, balanced=True)
    assert np.ptp(columns["a"]) < 0.1
    part = recorded({name: -values if name == wrong else values for name, values in columns.items()})
    with pytest.raises(RecordingError, match=message) if wrong else nullcontext():
        check_directions([part], PERIOD)


def test_a_pole_that_falls_upwards_is_refused(motion: Columns) -> None:
    part = recorded({**motion, "a": motion["a"] - np.pi})
    with pytest.raises(RecordingError, match="the pole falls upwards in the recordings"):
        check_recordings({"a": part}, {"b": part}, PERIOD)


BROKEN: dict[str, tuple[Callable[[Columns], Columns], list[str]]] = {
    "motor sign, beyond full": (
        lambda each: {"u": -1.2 * each["u"]},
        ["motor.positive", "beyond layout.motor.full=255"],
    ),
    "angle sign, jitter": (
        lambda each: {"a": -each["a"], "t": each["t"] + np.random.default_rng(2).uniform(0, 0.0035, STEPS)},
        ["angle.positive", "the time between rows varies"],
    ),
    "a motor value of at most 1": (
        lambda each: {"u": each["u"] / 255},
        [r"^the largest motor value is (1|0\.\d+), and layout\.motor\.full=255: .* largest value$"],
    ),
    "degrees": (lambda each: {"a": np.degrees(each["a"])}, ["may be in degrees"]),
    "radians, told as degrees": (lambda each: {"a": np.radians(each["a"])}, ["may be in radians"]),
    "degrees that wrap": (
        lambda each: {"a": np.degrees(wrap(each["a"]))},
        [r"jumps by 360 where a wraps.*in degrees; give layout\.angle\.unit=deg$"],
    ),
    "scale of 4 %, with wraps": (
        lambda each: {"a": wrap(1.04 * each["a"])},
        [r"0\.96\d times as far.* as layout\.angle\.wraps=6\.28319$"],
    ),
    "half the scale": (lambda each: {"a": each["a"] / 2}, [r"(2\.0|1\.9)\d+ times as far"]),
    "a motor value in every second row": (
        lambda each: {"u": np.where(np.arange(STEPS) % 2, np.nan, each["u"])},
        ["750 of 1500 rows were left out, with an empty, missing or surplus cell.* repeat its last value"],
    ),
    "scale of 4 %": (lambda each: {"a": 1.04 * each["a"]}, [r"0\.96\d times as far"]),
    "zero": (lambda each: {"a": each["a"] + 0.06}, ["upright where a is 0.0[56]"]),
    "millimetres": (lambda each: {"x": 1e3 * each["x"]}, ["may be in mm"]),
    "hanging at 0": (lambda each: {"a": each["a"] - np.pi}, ["layout.angle.upright is half a turn"]),
    "hanging at 0, angle sign": (
        lambda each: {"a": np.pi - each["a"]},
        ["layout.angle.upright is half a turn", "the other side for layout.angle.positive"],
    ),
    "milliseconds": (lambda each: {"t": 1e3 * each["t"]}, ["rows are 20000 ms apart.*time.unit$"]),
    "2 ms": (lambda each: {"t": each["t"] / 10}, ["rows are 2 ms apart.*layout.resample=true"]),
    "a row later": (lambda each: {"u": np.roll(each["u"], 1)}, ["layout.motor.row=in_force"]),
    "two rows later": (lambda each: {"u": np.roll(each["u"], 2)}, ["what was sent to the motor"]),
    "five rows later": (lambda each: {"u": np.roll(each["u"], 5)}, ["what was sent to the motor"]),
    "position sign": (lambda each: {"x": -each["x"]}, ["the other side for layout.position.positive$"]),
    "counter of 16 bits": (
        lambda each: {"x": (each["x"] + 0.01) % 0.3},
        ["the cart would be faster than 5 m/s"],
    ),
    "pole's counter of 16 bits": (
        lambda each: {"a": each["a"] % 4},
        [r"^the angle jumps by 3\.999\d+ where a wraps, .* 6\.28319: give layout\.angle\.wraps=3\.999"],
    ),
    "one leap": (
        lambda each: {"a": each["a"] + 10 * (np.arange(STEPS) > 700)},
        ["^the angle leaps in 1 of 1500 rows, first in row 702 of log.csv: "],
    ),
    "states of every other row": (
        lambda each: {name: np.repeat(each[name][::2], 2) for name in "xa"},
        ["rows are written more often than the cart is measured"],
    ),
    "three rows earlier": (lambda each: {"u": np.roll(each["u"], -3)}, ["over 50 ms later"]),
    "eight rows earlier": (lambda each: {"u": np.roll(each["u"], -8)}, ["over 50 ms later"]),
}


@pytest.mark.parametrize(("convert", "expected"), BROKEN.values(), ids=BROKEN)
def test_each_fault_of_a_log_is_a_doubt(
    doubts: Doubts, motion: Columns, convert: Callable[[Columns], Columns], expected: list[str]
) -> None:
    found = doubts({**motion, **convert(motion)})
    for doubt in expected:
        assert any(re.search(doubt, each) for each in found), found
    alone = "time", "half a turn", "position.positive", "more often", "leaps"
    if any(each in expected[0] for each in alone):  # nothing else is wrong
        assert len(found) == len(expected)


@pytest.mark.parametrize(("positive", "sign"), [("right", 1), ("left", -1)])
def test_the_upright_is_told_in_the_column_s_own_units(
    doubts: Doubts, motion: Columns, positive: str, sign: int
) -> None:
    column = {"name": "a", "unit": "deg", "positive": positive, "upright": 180.0}
    (found,) = doubts({**motion, "a": 184 + sign * np.degrees(motion["a"])}, angle=column)
    told = re.search(r"^the pole is upright where a is ([\d.]+) .*, not 180: give it as layout", found)
    assert told is not None
    assert float(told[1]) == pytest.approx(184, abs=0.5)


def test_a_column_that_wraps_against_its_layout_is_told(doubts: Doubts, motion: Columns) -> None:
    column = {"name": "a", "wraps": False}
    (found,) = doubts({**motion, "a": wrap(motion["a"])}, angle=column)
    assert found == "the angle jumps by 6.28319 where a wraps: give layout.angle.wraps=true"


OF_BALANCED: dict[str, tuple[int, float, float, str]] = {
    "as it is": (1, 0, 0, ""),
    "noisy": (1, 0, 2, ""),
    "hanging at 0": (1, np.pi, 0, "pole falls upwards.*half a turn off"),
    "angle sign": (-1, 0, 0, "pole runs ahead.*for layout.angle.positive$"),
    "noisy, hanging at 0": (
        1,
        np.pi,
        0.3,
        "runs ahead.*layout.angle.positive, or mend layout.angle.upright, which may be half a turn off$",
    ),
}


@pytest.mark.parametrize(("sign", "turned", "noise", "expected"), OF_BALANCED.values(), ids=OF_BALANCED)
def test_a_balanced_pole_tells_half_a_turn_from_a_wrong_side(
    doubts: Doubts, balanced: Columns, sign: int, turned: float, noise: float, expected: str
) -> None:
    """With noise, in degrees, gravity seems to pull the wrong way, and says nothing."""
    errors = np.radians(noise) * np.random.default_rng(1).normal(size=STEPS)
    found = doubts({**balanced, "a": sign * balanced["a"] + turned + errors})
    assert [re.search(expected, each) is not None for each in found] == [True] * bool(expected), found


@pytest.mark.parametrize(("period", "known"), [(0.02, True), (0.001, False), (1.0, False)])
def test_no_sensor_is_estimated_with_a_period_that_is_refused(
    tmp_path: Path, motion: Columns, period: float, known: bool
) -> None:
    """With one of 1 ms it would take minutes."""
    path = written(tmp_path / "log.csv", {**motion, "t": period * np.arange(STEPS)})
    sensors = import_logs(imported(path, shortest=1), tmp_path / "run")
    assert sensors is not None
    assert (sensors.delay is not None) == known


def test_logs_of_several_periods_are_refused(tmp_path: Path, motion: Columns) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    written(folder / "a.csv", motion)
    written(folder / "b.csv", {**motion, "t": motion["t"] / 2})
    with pytest.raises(RecordingError, match=r"b\.csv has a row every 10 ms, a\.csv every 20 ms"):
        import_logs(imported(folder), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("without_pictures")
def test_the_command_imports_what_identify_and_replay_take(tmp_path: Path, motion: Columns) -> None:
    written(tmp_path / "log.csv", motion)
    (tmp_path / "mine.yaml").write_text("defaults: [plain]\ntime: {name: t}\nposition: {name: x}\n")
    given = ("from=log.csv", "layout=mine.yaml", "layout.angle.name=a", "layout.motor={name: u, full: 255}")
    given += ("cart=ip02",)
    done = in_process("import", *given, "hydra.run.dir=run", folder=tmp_path)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[-1] == "cartpole-identify from=run cart=ip02 pole=<yours>.yaml"
    done = in_process("replay", "from=run", "pole=medium", "hydra.run.dir=replayed", folder=tmp_path)
    assert (done.code, done.err) == (0, "")
    again = in_process("import", *given, "hydra.run.dir=run", folder=tmp_path)
    assert again.complaint.endswith("/run: it holds a run already; give another folder")


def test_a_file_beside_the_logs_is_left_out(
    tmp_path: Path, motion: Columns, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    notes = folder / "notes.txt"
    notes.write_text("on Monday\nthe cart was cold\nand the pole bent\n")
    (folder / "measures.txt").write_bytes("Maße".encode("latin-1"))
    np.savez(folder / "aborted.npz", **{name: values[:1] for name, values in motion.items()})
    written(folder / "aborted.csv", {name: values[:1] for name, values in motion.items()})
    reasons = {
        "notes.txt": " has no column t, x, a, u; it has on, Monday",
        "measures.txt": " cannot be read: it is not UTF-8 text; unpack it, or save it as UTF-8",
        "aborted.npz": " has fewer than two rows with a number in each of t, x, a, u",
        "aborted.csv": " has fewer than two rows with a number in each of t, x, a, u",
    }
    for name, reason in reasons.items():
        with pytest.raises(RecordingError, match=re.escape(f"{name}{reason}")):
            import_logs(imported(folder / name), tmp_path / "run")
    with pytest.raises(RecordingError, match=re.escape(f"aborted.csv{reasons['aborted.csv']}")):
        import_logs(imported(folder), tmp_path / "run")
    short = {name: values[:2] for name, values in motion.items()}
    written(folder / "short.csv", {**short, "t": np.array([0, 0.5])})  # of no period
    written(folder / "a.csv", motion)
    for other in ("bag_0.mcap", "c.csv.gz"):
        (folder / other).write_bytes(b"of another kind")
    import_logs(imported(folder), tmp_path / "run")
    said = capsys.readouterr()
    for name, reason in reasons.items():
        assert f"note: left out: {folder / name}{reason}" in said.err
    assert re.search(r"note: left out: files of .* that are no \.csv.*: \.gz, \.mcap; unpack", said.err)
    assert "doubt: " not in said.out
    assert {path.name[:2] for path in (tmp_path / "run/recordings").iterdir()} == {"a_"}
    written(folder / "b.csv", {"t": motion["t"], "x": motion["x"]})
    with pytest.raises(RecordingError, match=r"b\.csv has no column a, u; it has t, x"):
        import_logs(imported(folder), tmp_path / "more")


def test_no_log_of_a_folder_replaces_another(tmp_path: Path, motion: Columns) -> None:
    (tmp_path / "logs").mkdir()
    names = "a.csv", "a.txt", "a.csv.txt", "01_run.csv", "02_run.csv"
    for name in names:
        written(tmp_path / "logs" / name, {column: values[:200] for column, values in motion.items()})
    (tmp_path / "logs/a_folder.csv").mkdir()
    import_logs(imported(tmp_path / "logs"), tmp_path / "run")
    assert len(experiments(tmp_path / "run")) == len(names)


def test_a_position_that_no_encoder_counts_is_one_line(tmp_path: Path, motion: Columns) -> None:
    columns = {**motion, "x": motion["x"].copy()}
    columns["x"][50] = 1e300
    path = written(tmp_path / "log.csv", columns)
    with pytest.raises(RecordingError, match=r"log.csv: x is 1e\+300 in row 51, which no encoder counts"):
        import_logs(imported(path), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_layout_of_the_guide_is_taken(tmp_path: Path) -> None:
    page = (conf_folder().parent / "docs/identification.md").read_text()
    lines = page[page.index("    defaults: [plain]") :].partition("\n\n")[0]
    (tmp_path / "mine.yaml").write_text(textwrap.dedent(lines))
    given = {"from": "log.csv", "layout": tmp_path / "mine.yaml"}
    taken = validated(ImportConfig, compose("import", given)).layout
    assert (taken.time.name, taken.motor.row, taken.keep) == ("t_ms", "in_force", {"error": (0, 0)})


def test_a_few_values_of_a_potentiometers_dead_zone_are_no_doubt(doubts: Doubts, motion: Columns) -> None:
    angle = motion["a"].copy()
    angle[[300, 900]] += 2.0, 2.8
    assert not any("leaps" in each for each in doubts({**motion, "a": angle}))


@pytest.mark.parametrize("late", [0, 10])
def test_a_good_log_has_no_doubt_and_becomes_recordings(tmp_path: Path, doubts: Doubts, late: int) -> None:
    motion = driven_pole(255, late)
    assert doubts(motion) == []
    episode = read_recording(tmp_path / "run" / "recordings" / "log_00.csv").episode
    assert episode.theta == pytest.approx(motion["a"], abs=1e-3)
