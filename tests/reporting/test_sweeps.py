"""Any runs are grouped by the settings that differ, and two sets are compared group by group."""

import csv
import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.runs_page import comparison
from cartpole_rl.reporting.sweeps import Sweep, grouped, read_sweeps, results_of, table

Edit = Callable[[Path, Callable[[Any], object]], None]
MEASURE = "score_upright"


def cells(page: str, column: str) -> list[str]:
    """The cells of a column."""
    return re.findall(f'data-label="{re.escape(column)}">([^<]*)</td>', page)


def read_sweep(name: str, sources: list[str], measure: str) -> Sweep:
    """The runs of one set."""
    (sweep,) = read_sweeps({name: sources}, measure)
    return sweep


def test_runs_are_grouped_by_the_settings_that_differ(study: Path) -> None:
    (sweep,), between = grouped([read_sweep("runs", ["quick/friction"], MEASURE)])
    results = results_of(sweep, MEASURE)
    assert between == {}
    assert [group.label for group in results.groups] == [
        "cart_viscous=0.2, cart_mass=1.5",
        "cart_viscous=0.2",
        "cart_viscous=3, cart_mass=1.5",
        "cart_viscous=3",
    ]
    for group in results.groups:
        assert [agent.seed for agent in results.agents if agent.group == group.name] == [10, 11, 12]
    of_study = {agent.run: agent.values["own"] for agent in results.agents}
    metrics = json.loads((study / "much/11/evaluations/heavy/metrics.json").read_text())
    assert of_study["quick/friction/much/11/evaluations/heavy"] == metrics[MEASURE]["mean"]


def test_the_table_has_a_row_for_every_run(study: Path) -> None:
    (study / "much/11/evaluations/heavy/metrics.json").unlink()
    (sweep,), _ = grouped([read_sweep("runs", ["quick"], MEASURE)])
    rows = list(csv.DictReader(io.StringIO(table([sweep]))))
    assert len(rows) == 12
    assert [row["left_out"] for row in rows if row["left_out"]] == ["unfinished: it has no metrics.json"]
    by_run = {row["run"]: row for row in rows}
    metrics = json.loads((study / "much/12/evaluations/heavy/metrics.json").read_text())
    row = by_run["quick/friction/much/12/evaluations/heavy"]
    assert float(row["score"]) == metrics["score"]["mean"]
    assert (row["seed"], row["setting:parameters.cart_mass"]) == ("12", "1.5")


def test_patterns_and_lists_name_runs(study: Path) -> None:
    one = read_sweep("runs", ["quick/*/much/*/evaluations/heavy"], MEASURE)
    two = read_sweep(
        "runs", ["quick/friction/much/10", "quick/friction/much/11", "quick/friction/much/10"], MEASURE
    )
    assert (len(one.members), len(two.members)) == (3, 4)
    with pytest.raises(ConfigError, match=r"compare=quick/none\*: there is no such folder"):
        read_sweep("compare", ["quick/none*"], MEASURE)


def test_runs_of_another_command_version_or_without_measure_are_named(study: Path, edit: Edit) -> None:
    nominal = [f"quick/friction/much/{seed}/evaluations/nominal" for seed in (10, 11, 12)]
    edit(Path(nominal[0], "provenance.json"), lambda content: content.update(program="cartpole-record"))
    edit(Path(nominal[1], "provenance.json"), lambda content: content["packages"].update(numpy="1.0"))
    edit(Path(nominal[2], "metrics.json"), lambda content: content.update(score_upright=None))
    sweep = read_sweep("runs", ["quick"], MEASURE)
    reasons = {each.run: each.reason for each in sweep.exclusions}
    assert len(sweep.members) == 9
    assert reasons[nominal[0]] == "other commands: cartpole-record instead of cartpole-evaluate"
    assert reasons[nominal[1]].startswith("other versions: ")
    assert reasons[nominal[2]] == "it has no score_upright"


def test_a_seed_counts_once_and_unequal_seeds_are_noted(study: Path) -> None:
    shutil.copytree(study / "much/10/evaluations/heavy", "quick/zzz_again")
    shutil.rmtree(study / "little/11/evaluations/heavy")
    (sweep,), _ = grouped([read_sweep("runs", ["quick"], MEASURE)])
    results = results_of(sweep, MEASURE)
    assert [(each.run, each.reason) for each in results.exclusions] == [
        ("quick/zzz_again", "seed 10 of cart_viscous=3, cart_mass=1.5 is there twice")
    ]
    assert "cart_viscous=0.2, cart_mass=1.5 lacks seed 11" in results.notes


def test_two_sets_are_compared_group_by_group(study: Path) -> None:
    sweeps, between = grouped(
        [
            read_sweep("runs", ["quick/friction/little"], MEASURE),
            read_sweep("compare", ["quick/friction/much", "quick/friction/little/10"], MEASURE),
        ]
    )
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    assert between == {}  # the second set has both frictions
    page = comparison(first, second, between)
    assert cells(page, "group") == ["cart_viscous=0.2, cart_mass=1.5", "cart_viscous=0.2"]
    lone = {"cart_viscous=3, cart_mass=1.5 is only in compare.", "cart_viscous=3 is only in compare."}
    assert {*re.findall("<p>([^<]* is only in [^<]*)</p>", page)} == lone


def test_settings_that_tell_two_sets_apart_are_not_part_of_the_groups(study: Path) -> None:
    sweeps, between = grouped(
        [
            read_sweep(name, [f"quick/friction/{arm}"], MEASURE)
            for name, arm in (("runs", "little"), ("compare", "much"))
        ]
    )
    assert between == {"parameters.cart_viscous": ["0.2", "3"]}
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    page = comparison(first, second, between)
    assert cells(page, "group") == ["cart_mass=1.5", "default"]
    assert [cells(page, name)[0] for name in ("setting", "runs", "compare")] == [
        "parameters.cart_viscous",
        "0.2",
        "3",
    ]
    means = first.estimates("own"), second.estimates("own")
    differences = cells(page, "difference, 95 % interval")
    for label, text in zip(("cart_mass=1.5", "default"), differences, strict=True):
        assert float(text.split()[0]) == pytest.approx(means[1][label].value - means[0][label].value, abs=0.1)
    assert "is only in" not in page


def test_long_labels_have_the_same_number_in_both_sets(study: Path, edit: Edit) -> None:
    long = {"cart_mass": 0.7123, "pole_viscous": 0.00123, "cart_coulomb": 0.81234}
    for arm, factor in (("little", 1), ("much", 2)):
        for config in (study / arm).glob("*/evaluations/*/config.yaml"):
            values = {name: factor * value for name, value in long.items()}
            edit(config, lambda content, values=values: content["parameters"].update(values))
    for folder in study.glob("*/*/evaluations/nominal"):
        words = [f"parameters.{name}=1" for name in long]
        edit(folder / "provenance.json", lambda content, words=words: content.update(command=words))
    shutil.copytree("quick", "other")
    Path("other/friction/little").rename("other/friction/zzz")  # now the last of its set
    sets = {
        name: [f"{root}/*/*/*/evaluations/nominal"]
        for name, root in (("runs", "quick"), ("compare", "other"))
    }
    sweeps, between = grouped(read_sweeps(sets, MEASURE))
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    assert all(len(each.label) > 48 and each.label[0] in "12" for each in first.groups)
    page = comparison(first, second, between)
    assert "is only in" not in page
    assert [float(text.split()[0]) for text in cells(page, "difference, 95 % interval")] == [0, 0]


def test_failed_jobs_and_links_are_named_or_followed(study: Path) -> None:
    failed = study / "much/11/evaluations/heavy"
    shutil.rmtree(failed)
    failed.mkdir()
    (failed / "error.txt").write_text("ConfigError: cart_mass is -1\n")
    shutil.move(study / "much/12/evaluations/heavy", "away")
    (study / "much/12/evaluations/heavy").symlink_to(Path("away").resolve())
    (study / "again").symlink_to((study / "much/10").resolve())
    sweep = read_sweep("runs", ["quick/friction"], MEASURE)
    assert len(sweep.members) == 11
    assert [(each.run, each.reason) for each in sweep.exclusions] == [
        (failed.as_posix(), "failed: ConfigError: cart_mass is -1")
    ]


def test_the_agents_of_evaluations_count(study: Path, edit: Edit) -> None:
    for seed in (10, 11, 12):
        heavy = study / f"much/{seed}/evaluations/heavy"
        shutil.copytree(heavy, f"agents/{seed}")
        edit(heavy / "config.yaml", lambda content, seed=seed: content.update(run=f"agents/{seed}"))
    edit(Path("agents/11/provenance.json"), lambda content: content["packages"].update(torch="1.0"))
    Path("agents/12/metrics.json").unlink()
    sweep = read_sweep("runs", ["quick/friction/*/*/evaluations/heavy"], MEASURE)
    reasons = {each.run: each.reason for each in sweep.exclusions}
    assert len(sweep.members) == 4
    assert reasons["quick/friction/much/12/evaluations/heavy"] == (
        "its agent agents/12: unfinished: it has no metrics.json"
    )
    assert "torch 1.0" in reasons["quick/friction/much/11/evaluations/heavy"]
    shutil.rmtree("agents")
    (lost,), _ = grouped([read_sweep("runs", ["quick/friction/*/*/evaluations/heavy"], MEASURE)])
    assert "The runs of 3 agents were not found and are not checked." in results_of(lost, MEASURE).notes


def test_agents_that_were_tuned_from_different_agents_are_different_groups(study: Path, edit: Edit) -> None:
    for seed, carts in ((10, 512), (11, 1024), (12, 1024)):
        heavy = study / f"much/{seed}/evaluations/heavy"
        for name, run in (("origins", None), ("tuned", f"origins/{seed}")):
            shutil.copytree(heavy, f"{name}/{seed}")
            edit(Path(name, str(seed), "config.yaml"), lambda content, run=run: content.update(run=run))
        edit(Path(f"origins/{seed}/config.yaml"), lambda content, carts=carts: content.update(carts=carts))
        edit(heavy / "config.yaml", lambda content, seed=seed: content.update(run=f"tuned/{seed}"))
    edit(Path("origins/10/config.yaml"), lambda content: content.update(run="tuned/10"))  # a circle
    (sweep,), _ = grouped([read_sweep("runs", ["quick/friction/much/*/evaluations/heavy"], MEASURE)])
    assert sweep.columns["agent.agent.carts"] == ["512", "1024", "1024"]
    assert len({*sweep.labels}) == 2
    for seed in (10, 11, 12):  # by default every fine-tuning has seed 0
        edit(Path(f"tuned/{seed}/config.yaml"), lambda content: content.update(seed=0))
    (sweep,), _ = grouped([read_sweep("runs", ["quick/friction/much/*/evaluations/heavy"], MEASURE)])
    assert [agent.seed for agent in results_of(sweep, MEASURE).agents] == [10, 11, 12]


def test_versions_and_commands_are_compared_over_both_sets(study: Path, edit: Edit) -> None:
    shutil.copytree("quick", "other")
    sets = {"runs": ["quick"], "compare": ["other"]}
    old = [*Path("other").rglob("provenance.json")]
    for file in old[:8]:  # most of the second set, fewest of both
        edit(file, lambda content: content["packages"].update(torch="1.0"))
    first, second = read_sweeps(sets, MEASURE)
    assert (len(first.members), len(second.members)) == (12, 4)
    for file in old:
        edit(file, lambda content: content["packages"].update(torch="1.0"))
        edit(file, lambda content: content.update(program="cartpole-record"))
    first, second = read_sweeps(sets, MEASURE)
    assert (len(first.members), len(second.members)) == (12, 12)
    commands, versions = second.notes
    assert commands == (
        "The commands of compare differ from the rest: cartpole-record, not cartpole-evaluate."
    )
    assert versions.startswith("The versions of compare differ from the rest: ")
    assert versions in results_of(grouped([second])[0][0], MEASURE).notes


def test_seeds_that_no_group_has_all_of_are_noted(study: Path) -> None:
    shutil.rmtree(study / "little/10")
    shutil.rmtree(study / "much/12")
    (sweep,), _ = grouped([read_sweep("runs", ["quick/friction/*/*/evaluations/nominal"], MEASURE)])
    notes = results_of(sweep, MEASURE).notes
    assert "cart_viscous=0.2 lacks seed 10" in notes
    assert "cart_viscous=3 lacks seed 12" in notes
