"""Recordings come back as they were written, other programs read them, and damaged ones are named."""

import csv
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.evaluation.recordings import (
    COLUMNS,
    GUARDED,
    Recording,
    read_heading,
    read_recording,
    write_recording,
)
from cartpole_rl.rig.hardware import Encoders, nominal_encoders
from cartpole_rl.tasks.episode import Episode


@pytest.fixture(scope="module")
def episode(simulated: Callable[..., CartPoleEnv]) -> Episode:
    """Forty periods of random motor values."""
    random = torch.Generator().manual_seed(0)
    (recorded,) = run_batch(
        simulated(time_limit=40), lambda td: td.set("action", torch.randint(3, (1,), generator=random))
    )
    return recorded


def with_cell(text: str, row: int, column: str, value: str) -> str:
    """The text of a recording with another value in a row, counted from 1."""
    lines = text.splitlines()
    first = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    cells = lines[first + row].split(",")
    cells[lines[first].split(",").index(column)] = value
    lines[first + row] = ",".join(cells)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("length", ["nan", "-1", "0", "long"])
def test_a_length_that_is_none_is_named(length: str, episode: Episode) -> None:
    with pytest.raises(RecordingError, match=f"recording own is damaged: pole_length_m is '{length}'"):
        _ = Recording("own", episode, {"pole_length_m": length}).pole_length


def test_a_recording_round_trips(tmp_path: Path, episode: Episode) -> None:
    write_recording(tmp_path / "deep" / "one.csv", episode)
    again = read_recording(tmp_path / "deep" / "one.csv").episode
    assert again.origin is None  # no column of it; cartpole-record writes it into the heading
    for field in dataclasses.fields(Episode):
        if field.name != "origin":
            np.testing.assert_array_equal(getattr(again, field.name), getattr(episode, field.name))
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["one.csv"]


def test_any_reader_of_csv_sees_columns_with_units(tmp_path: Path, episode: Episode) -> None:
    write_recording(tmp_path / "one.csv", episode, {"pole": "medium"})
    lines = (tmp_path / "one.csv").read_text().splitlines()
    assert "# pole: medium" in lines
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert tuple(rows[0]) == (*COLUMNS, GUARDED)
    assert len(rows) == episode.steps + 1
    assert float(rows[7]["x_m"]) == episode.x[7]
    assert rows[-1]["motor"] == ""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("harm", "named"),
    [
        (lambda text: "nonsense", "not a recording"),
        (lambda text: text.replace("theta_rad", "theta"), "lacks theta_rad"),
        (lambda text: "\n".join(text.splitlines()[:3]), "lacks"),
        (lambda text: text.replace("ended_by: time", "ended_by: luck"), "damaged"),
        (lambda text: with_cell(text, 2, "theta_rad", "nan"), "theta is not finite in row 2"),
        (lambda text: with_cell(text, 2, "time_s", "0.0"), "time does not increase in row 2"),
        (lambda text: with_cell(text, 1, "motor", "999"), "beyond 255 in row 1; record it again"),
        (lambda text: with_cell(text, 3, "pole_counts", str(10**25)), "beyond 2147483647 in row 3; record"),
        (lambda text: with_cell(text, 4, "x_m", "1e308"), "x is beyond 1e\\+06 in row 4; record it again"),
        (lambda text: with_cell(text, 5, "motor", ""), "motor in row 5 is empty; give a whole number, or"),
        (lambda text: with_cell(text, 5, "motor", "-250.5"), "row 5 is '-250.5'; give a whole number"),
        (lambda text: with_cell(text, 6, "x_m", ""), "x_m in row 6 is empty; give a number, or leave"),
        (lambda text: with_cell(text, 7, "pole_counts", "1,5"), "damaged"),
        (lambda text: with_cell(text, 40, "score", "none"), "score in row 40 is 'none'; give a number"),
        (lambda text: with_cell(text, 2, "x_m", "9" * 140_000), "damaged: field larger than"),
        (lambda text: text[: len(text) // 2], "damaged"),
    ],
)
def test_a_damaged_file_is_named(
    tmp_path: Path, episode: Episode, harm: Callable[[str], str], named: str
) -> None:
    path = tmp_path / "one.csv"
    write_recording(path, episode)
    path.write_text(harm(path.read_text()))
    with pytest.raises(RecordingError, match=named) as raised:
        read_recording(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.filterwarnings("error")
def test_a_file_that_a_spreadsheet_program_saved_is_read(tmp_path: Path, episode: Episode) -> None:
    """It writes a byte-order mark, fills the lines of the heading, quotes some, and adds decimals."""
    path = tmp_path / "one.csv"
    write_recording(path, episode, {"pole": "medium", "start": '{"x": 0.1, "theta": 0.2}'})
    lines = path.read_text().splitlines()
    heading = [line for line in lines if line.startswith("#")]
    quoted = ['"{}"'.format(line.replace('"', '""')) if "," in line else line for line in heading]
    names, *rows = (line.split(",") for line in lines[len(heading) :])
    whole = [names.index(name) for name in ("motor", "cart_counts", "pole_counts")]
    decimals = [
        [f"{cell}.0" if place in whole and cell else cell for place, cell in enumerate(row)] for row in rows
    ]
    commas = "," * (len(names) - 1)
    path.write_text(
        "\n".join([f"{line}{commas}" for line in quoted] + [",".join(row) for row in [names, *decimals]]),
        encoding="utf-8-sig",
    )
    again = read_recording(path).episode
    np.testing.assert_array_equal(again.motor, episode.motor)
    np.testing.assert_array_equal(again.counts, episode.counts)
    assert (again.motor.dtype, again.counts.dtype) == (episode.motor.dtype, episode.counts.dtype)
    assert (again.ended_by, read_heading(path)[0]["pole"]) == (episode.ended_by, "medium")


def test_a_recording_keeps_the_encoders(episode: Episode, tmp_path: Path) -> None:
    path, encoders = tmp_path / "episode.csv", Encoders(4e-5, 2400)
    write_recording(path, dataclasses.replace(episode, encoders=encoders))
    assert read_recording(path).episode.encoders == encoders
    text = path.read_text()
    path.write_text("\n".join(line for line in text.splitlines() if "_per_" not in line or "," in line))
    assert read_recording(path).episode.encoders == nominal_encoders()
    path.write_text(text.replace("# pole_counts_per_turn: 2400", "# pole_counts_per_turn: 3"))
    with pytest.raises(RecordingError, match="in its heading, pole_counts_per_turn is 3"):
        read_recording(path)
