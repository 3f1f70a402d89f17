"""Every run and every episode is a row: as CSV, as Parquet, and as data for a frame."""

import csv
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import in_process

from cartpole_rl.reporting import tables
from cartpole_rl.reporting.sweeps import read_groups
from cartpole_rl.reporting.tables import episodes, run_rows, write_table

Edit = Callable[[Path, Callable[[Any], object]], None]
HEAVY = "much/12/evaluations/heavy"


def report(format: str = "csv") -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Make a report of the study; return its tables of runs and of episodes."""
    words = ("runs=quick", "measure=score_upright", f"format={format}", "hydra.run.dir=report")
    done = in_process("report", *words, folder=Path.cwd())
    assert done.code == 0, done.err
    runs, found = (Path("report", name).read_text().splitlines() for name in ("runs.csv", "episodes.csv"))
    return [*csv.DictReader(runs)], [*csv.DictReader(found)]


def test_the_tables_have_a_row_for_every_run_and_every_episode(study: Path) -> None:
    (study / "much/11/evaluations/heavy/metrics.json").unlink()
    shutil.copytree(study / "much/10/evaluations/heavy", "quick/zzz_again")
    runs, found = report()
    assert len(runs) == 13
    again = "seed 10 of cart_viscous=3, cart_mass=1.5 is there twice"
    assert [row["left_out"] for row in runs if row["left_out"]] == [
        again,
        "unfinished: it has no metrics.json",
    ]
    metrics = json.loads((study / HEAVY / "metrics.json").read_text())
    (run,) = (row for row in runs if row["run"] == f"quick/friction/{HEAVY}")
    assert float(run["score"]) == metrics["score"]["mean"]
    assert (run["seed"], run["setting:parameters.cart_mass"]) == ("12", "1.5")
    assert len(found) == 12 * 2
    of_run = [row for row in found if row["run"] == run["run"]]
    assert [row["episode"] for row in of_run] == ["0", "1"]
    for row, episode in zip(of_run, metrics["episodes"], strict=True):
        assert float(row["score"]) == episode["score"]
        assert float(row["start.theta"]) == episode["start"]["theta"]
        assert float(row["cart.cart_mass"]) == metrics["cart"]["cart_mass"]
        assert (row["ended_by"], row["plant"]) == (episode["ended_by"], "simulated")
        assert {name: row[name] for name in run if name.startswith("setting:")} == {
            name: value for name, value in run.items() if name.startswith("setting:")
        }
    assert {row["left_out"] for row in found if row["run"] == "quick/zzz_again"} == {again}


def test_a_fine_tuning_has_episodes_and_scores_before_and_after(study: Path, edit: Edit) -> None:
    folder = study / HEAVY
    metrics = json.loads((folder / "metrics.json").read_text())
    after = {**metrics, "score": {"mean": 5.0}, "episodes": metrics["episodes"][:1]}
    (folder / "comparison.json").write_text(json.dumps({"before": metrics, "after": after, "kept": "before"}))
    rows = [row for row in episodes("quick") if row["run"] == f"quick/friction/{HEAVY}"]
    assert [(row["stage"], row["episode"]) for row in rows] == [("before", 0), ("before", 1), ("after", 0)]
    edit(folder / "provenance.json", lambda content: content.update(program="cartpole-finetune"))
    (run,) = (row for row in run_rows(read_groups({"runs": ["quick"]}, "score")[0]) if row.get("kept"))
    expected = {
        "score": metrics["score"]["mean"],
        "score_before": metrics["score"]["mean"],
        "score_after": 5.0,
    }
    assert {name: run[name] for name in expected} == expected
    assert (run["run"], run["kept"]) == (f"quick/friction/{HEAVY}", "before")


def test_parquet_holds_what_csv_holds(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason='pip install "cartpole_rl[parquet]"')
    monkeypatch.setattr(tables, "BATCH", 7)
    _, found = report("[csv,parquet]")
    read = parquet.read_table("report/episodes.parquet").to_pylist()
    texts = [{name: "" if value is None else str(value) for name, value in row.items()} for row in read]
    assert texts == found
    assert isinstance(read[0]["score"], float)


def test_parquet_without_its_library_is_refused_in_one_line(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cartpole_rl.workflows.checks.find_spec", lambda name: None)
    done = in_process("report", "runs=quick", "format=parquet", "hydra.run.dir=report", folder=Path.cwd())
    assert done.code == 2
    assert 'format=parquet needs PyArrow: pip install "cartpole_rl[parquet]"' in done.complaint
    assert not Path("report").exists()


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_name_that_is_not_utf_8_is_escaped(suffix: str, tmp_path: Path) -> None:
    rows = [{"run": os.fsdecode(b"caf\xe9"), "seed": 0}]
    if suffix == "parquet":
        pytest.importorskip("pyarrow", reason="it is an extra")
    write_table(lambda: rows, path := tmp_path / f"runs.{suffix}")
    assert b"caf\\udce9" in path.read_bytes()
