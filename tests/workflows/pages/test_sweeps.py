"""Any runs are grouped by the settings that differ, and two sets are compared group by group."""

import csv
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.comparison import compare
from cartpole_rl.workflows.pages.sweeps import grouped, read_sweep, results_of, table

Edit = Callable[[Path, Callable[[Any], object]], None]
MEASURE = "score_upright"


def test_runs_are_grouped_by_the_settings_that_differ(study: Path) -> None:
    (sweep,), between = grouped([read_sweep("runs", ["quick/friction"], MEASURE)])
    results = results_of(sweep, MEASURE)
    assert between == {}
    assert [arm.label for arm in results.study.arms] == [
        "cart_viscous=0.2, cart_mass=1.5",
        "cart_viscous=0.2",
        "cart_viscous=3, cart_mass=1.5",
        "cart_viscous=3",
    ]
    for arm in results.study.arms:
        assert [agent.seed for agent in results.agents if agent.arm == arm.name] == [0, 1, 2]
    of_study = {agent.run: agent.values["own"] for agent in results.agents}
    metrics = json.loads((study / "much/1/evaluations/heavy/metrics.json").read_text())
    assert of_study["quick/friction/much/1/evaluations/heavy"] == metrics[MEASURE]["mean"]


def test_the_table_has_a_row_for_every_run(study: Path) -> None:
    (study / "much/1/evaluations/heavy/metrics.json").unlink()
    (sweep,), _ = grouped([read_sweep("runs", ["quick"], MEASURE)])
    rows = list(csv.DictReader(io.StringIO(table([sweep]))))
    assert len(rows) == 12
    assert [row["left_out"] for row in rows if row["left_out"]] == ["unfinished: it has no metrics.json"]
    by_run = {row["run"]: row for row in rows}
    metrics = json.loads((study / "much/2/evaluations/heavy/metrics.json").read_text())
    row = by_run["quick/friction/much/2/evaluations/heavy"]
    assert float(row["score"]) == metrics["score"]["mean"]
    assert (row["seed"], row["setting:parameters.cart_mass"]) == ("2", "1.5")


def test_patterns_and_lists_name_runs(study: Path) -> None:
    one = read_sweep("runs", ["quick/*/much/*/evaluations/heavy"], MEASURE)
    two = read_sweep(
        "runs", ["quick/friction/much/0", "quick/friction/much/1", "quick/friction/much/0"], MEASURE
    )
    assert (len(one.members), len(two.members)) == (3, 4)
    with pytest.raises(ConfigError, match=r"compare=quick/none\*: there is no such folder"):
        read_sweep("compare", ["quick/none*"], MEASURE)


def test_runs_of_another_command_version_or_without_measure_are_named(study: Path, edit: Edit) -> None:
    nominal = [f"quick/friction/much/{seed}/evaluations/nominal" for seed in (0, 1, 2)]
    edit(Path(nominal[0], "provenance.json"), lambda content: content.update(program="cartpole-record"))
    edit(Path(nominal[1], "provenance.json"), lambda content: content["packages"].update(numpy="1.0"))
    edit(Path(nominal[2], "metrics.json"), lambda content: content.update(score_upright=None))
    sweep = read_sweep("runs", ["quick"], MEASURE)
    reasons = {each.run: each.reason for each in sweep.exclusions}
    assert len(sweep.members) == 9
    assert reasons[nominal[0]] == "a run of cartpole-record among runs of cartpole-evaluate"
    assert reasons[nominal[1]].startswith("other versions: ")
    assert reasons[nominal[2]] == "it has no score_upright"


def test_a_seed_counts_once_and_unequal_seeds_are_noted(study: Path) -> None:
    shutil.copytree(study / "much/0/evaluations/heavy", "quick/zzz_again")
    shutil.rmtree(study / "little/1/evaluations/heavy")
    (sweep,), _ = grouped([read_sweep("runs", ["quick"], MEASURE)])
    results = results_of(sweep, MEASURE)
    assert [(each.run, each.reason) for each in results.exclusions] == [
        ("quick/zzz_again", "seed 0 of cart_viscous=3, cart_mass=1.5 is there twice")
    ]
    assert "cart_viscous=0.2, cart_mass=1.5 lacks seed 1" in results.notes


def test_two_sets_are_compared_group_by_group(study: Path) -> None:
    sweeps, between = grouped(
        [
            read_sweep("runs", ["quick/friction/little"], MEASURE),
            read_sweep("compare", ["quick/friction/much", "quick/friction/little/0"], MEASURE),
        ]
    )
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    assert between == {}  # the second set has both frictions
    found = compare(first, second, between)
    assert [pair.label for pair in found.pairs] == ["cart_viscous=0.2, cart_mass=1.5", "cart_viscous=0.2"]
    assert {label for _, label in found.lone} == {"cart_viscous=3, cart_mass=1.5", "cart_viscous=3"}


def test_settings_that_tell_two_sets_apart_are_not_part_of_the_groups(study: Path) -> None:
    sweeps, between = grouped(
        [
            read_sweep(name, [f"quick/friction/{arm}"], MEASURE)
            for name, arm in (("runs", "little"), ("compare", "much"))
        ]
    )
    assert between == {"parameters.cart_viscous": ["0.2", "3"]}
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    found = compare(first, second, between)
    assert [pair.label for pair in found.pairs] == ["cart_mass=1.5", "default"]
    for pair in found.pairs:
        assert pair.difference.value == pytest.approx(pair.second.value - pair.first.value)
    assert found.lone == []
