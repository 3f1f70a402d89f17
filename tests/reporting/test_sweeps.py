"""Any runs are grouped by the settings that differ, and two sets are compared group by group."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.results import Results
from cartpole_rl.reporting.runs_page import Gallery, comparison
from cartpole_rl.reporting.sweeps import Sweep, grouped, read_groups, read_sweeps, results_of
from cartpole_rl.reporting.tables import run_rows
from cartpole_rl.run_folder import file_hash

Edit = Callable[[Path, Callable[[Any], object]], None]
MEASURE = "score_upright"


def cells(page: str, column: str) -> list[str]:
    """The cells of a column."""
    return re.findall(f'data-label="{re.escape(column)}">([^<]*)</td>', page)


def read_sweep(*sources: str, name: str = "runs") -> Sweep:
    """The runs of one set."""
    (sweep,) = read_sweeps({name: sources}, MEASURE)
    return replace(sweep, name=name)


def results_in(*sources: str) -> Results:
    """The results of one set of a single command."""
    (sweep,), _ = read_groups({"runs": sources}, MEASURE)
    return results_of(sweep, MEASURE)


def test_runs_are_grouped_by_the_settings_that_differ(study: Path) -> None:
    (sweep,), between = grouped([read_sweep("quick/friction")])
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


@pytest.mark.parametrize(("period", "seconds", "good"), [(0.02, 10, 2000), (0.01, 10, 4000), (0.02, 5, None)])
def test_a_good_score_is_that_of_so_many_periods(
    period: float, seconds: float, good: float | None, study: Path
) -> None:
    (sweep,), _ = read_groups({"runs": ["quick/friction"]}, "score")
    config = {"evaluated": {"control_period": period, "task": {"time_limit": round(seconds / period)}}}
    members = [replace(member, run=replace(member.run, config=config)) for member in sweep.members]
    assert results_of(replace(sweep, members=members), "score").good == good


def test_patterns_and_lists_name_runs(study: Path) -> None:
    one = read_sweep("quick/*/much/*/evaluations/heavy")
    two = read_sweep("quick/friction/much/10", "quick/friction/much/11", "quick/friction/much/10")
    assert (len(one.members), len(two.members)) == (3, 4)
    with pytest.raises(ConfigError, match=r"compare=quick/none\*: there is no such folder"):
        read_sweep("quick/none*", name="compare")


def test_runs_of_another_command_version_or_without_measure_are_named(study: Path, edit: Edit) -> None:
    nominal = [f"quick/friction/much/{seed}/evaluations/nominal" for seed in (10, 11, 12)]
    edit(Path(nominal[0], "provenance.json"), lambda content: content.update(program="cartpole-record"))
    edit(Path(nominal[1], "provenance.json"), lambda content: content["packages"].update(numpy="1.0"))
    edit(Path(nominal[2], "metrics.json"), lambda content: content.update(score_upright=None))
    evaluated, recorded = read_sweeps({"runs": ["quick"]}, MEASURE)
    assert (evaluated.name, recorded.name) == ("evaluate", "record")
    assert (len(evaluated.members), len(recorded.members)) == (9, 1)
    sweeps = read_sweeps({"runs": ["quick"], "compare": ["quick/friction/little"]}, MEASURE)
    reasons = {each.run: each.reason for each in sweeps[0].exclusions}
    assert reasons[nominal[0]] == "other commands: cartpole-record instead of cartpole-evaluate"
    assert reasons[nominal[1]].startswith("other versions: ")
    assert reasons[nominal[2]] == "it has no score_upright"


def test_a_seed_counts_once_and_unequal_seeds_are_noted(study: Path) -> None:
    shutil.copytree(study / "much/10/evaluations/heavy", "quick/zzz_again")
    shutil.rmtree(study / "little/11/evaluations/heavy")
    results = results_in("quick")
    assert [(each.run, each.reason) for each in results.exclusions] == [
        ("quick/zzz_again", "seed 10 of cart_viscous=3, cart_mass=1.5 is there twice")
    ]
    assert "cart_viscous=0.2, cart_mass=1.5 lacks seed 11" in results.notes


def test_two_sets_are_compared_group_by_group(study: Path) -> None:
    others = read_sweep("quick/friction/much", "quick/friction/little/10", name="compare")
    sweeps, between = grouped([read_sweep("quick/friction/little"), others])
    first, second = (results_of(sweep, MEASURE) for sweep in sweeps)
    assert between == {}  # the second set has both frictions
    page = comparison(first, second, between)
    assert cells(page, "group") == ["cart_viscous=0.2, cart_mass=1.5", "cart_viscous=0.2"]
    lone = {"cart_viscous=3, cart_mass=1.5 is only in compare.", "cart_viscous=3 is only in compare."}
    assert {*re.findall("<p>([^<]* is only in [^<]*)</p>", page)} == lone


def test_settings_that_tell_two_sets_apart_are_not_part_of_the_groups(study: Path) -> None:
    much = read_sweep("quick/friction/much", name="compare")
    sweeps, between = grouped([read_sweep("quick/friction/little"), much])
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
    assert cells(page, "agents") == ["3, paired"] * 2  # energy and LQR with the same seeds


def test_failed_jobs_and_links_are_named_or_followed(study: Path) -> None:
    failed = study / "much/11/evaluations/heavy"
    shutil.rmtree(failed)
    failed.mkdir()
    (failed / "error.txt").write_text("ConfigError: cart_mass is -1\n")
    shutil.move(study / "much/12/evaluations/heavy", "away")
    (study / "much/12/evaluations/heavy").symlink_to(Path("away").resolve())
    (study / "again").symlink_to((study / "much/10").resolve())
    sweep = read_sweep("quick/friction")
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
    sweep = read_sweep("quick/friction/*/*/evaluations/heavy")
    reasons = {each.run: each.reason for each in sweep.exclusions}
    assert len(sweep.members) == 4
    assert reasons["quick/friction/much/12/evaluations/heavy"] == (
        "its agent agents/12: unfinished: it has no metrics.json"
    )
    assert "torch 1.0" in reasons["quick/friction/much/11/evaluations/heavy"]
    shutil.rmtree("agents")
    lost = "The runs of 3 agents were not found and are not checked."
    assert lost in results_in("quick/friction/*/*/evaluations/heavy").notes
    edit(study / "much/10/evaluations/heavy/config.yaml", lambda content: content.update(run="."))
    assert lost in results_in("quick/friction/*/*/evaluations/heavy").notes


def test_an_agent_is_found_by_its_hash_from_anywhere(
    study: Path, edit: Edit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another project has another agent of the same name; an absolute path is of before a copy."""
    heavy, runs = study / "much/10/evaluations/heavy", []
    for place, seed in ((study / "runs/first", 7), (Path("other/runs/first"), 8)):
        shutil.copytree(study / "much/11/evaluations/heavy", place)
        edit(place / "config.yaml", lambda content, seed=seed: content.update(seed=seed))
        (place / "checkpoints").mkdir()
        (place / "checkpoints/last.pt").write_bytes(bytes([seed]))
    used = file_hash(study / "runs/first/checkpoints/last.pt")
    edit(heavy / "provenance.json", lambda content: content.update(agent_sha256=used))
    home = heavy.absolute()
    monkeypatch.chdir("other")
    for named in ("runs/first", "/elsewhere/runs/first"):
        edit(home / "config.yaml", lambda content, named=named: content.update(run=named))
        (member,) = read_sweep(str(home)).members
        runs.append((member.agent and member.agent.folder, member.seeds))
    assert runs == [(home.parents[3] / "runs/first", (7,))] * 2
    (home.parents[3] / "runs/first").rename(home.parents[3] / "renamed")
    edit(home / "config.yaml", lambda content: content.update(run="runs/first", seed=5))
    shutil.rmtree("runs")
    (member,) = read_sweep(str(home)).members
    assert (member.agent, member.seeds) == (None, ())  # the seed of the evaluation is not the agent's
    shutil.copytree(home, home.parent / "second")
    edit(home.parent / "second/provenance.json", lambda content: content.update(agent_sha256="of another"))
    assert len(results_in(str(home), str(home.parent / "second")).agents) == 2  # by their hashes


def test_an_unrelated_agent_of_the_same_name_condemns_no_copied_run(study: Path, edit: Edit) -> None:
    heavy, other = study / "much/10/evaluations/heavy", Path("runs/first/checkpoints/last.pt")
    other.parent.mkdir(parents=True)
    other.write_bytes(b"of this project")
    edit(heavy / "config.yaml", lambda content: content.update(run="/elsewhere/runs/first"))
    edit(heavy / "provenance.json", lambda content: content.update(agent_sha256="of another"))
    (member,) = read_sweep(str(heavy)).members
    assert (member.agent, member.problem) == (None, "")


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


def test_evaluations_of_an_agent_stand_side_by_side(study: Path, edit: Edit) -> None:
    for seed in (10, 11, 12):
        for arm in ("little", "much"):
            agent = Path(f"agents/{arm}/{seed}")
            shutil.copytree(study / f"{arm}/{seed}/evaluations/nominal", agent)
            for kind in ("nominal", "heavy"):
                file = study / f"{arm}/{seed}/evaluations/{kind}/config.yaml"
                edit(file, lambda content, agent=agent: content.update(run=str(agent)))
                edit(file, lambda content: content["parameters"].pop("cart_viscous"))
    (sweep,), between = read_groups({"runs": ["quick"]}, MEASURE)
    results = results_of(sweep, MEASURE)
    assert between is None
    assert [group.label for group in results.groups] == ["cart_viscous=0.2", "cart_viscous=3"]
    assert [each.label for each in results.evaluations] == ["cart_mass=1.5", "default"]
    assert [(agent.seed, len(agent.values)) for agent in results.agents] == [(10, 2), (11, 2), (12, 2)] * 2
    agent = results.agents[0]
    heavy = results.folder_of(agent, "cart_mass=1.5")
    assert heavy == study / "little/10/evaluations/heavy"
    metrics = json.loads((heavy / "metrics.json").read_text())
    assert agent.values["cart_mass=1.5"] == metrics[MEASURE]["mean"]


def test_a_fine_tuning_is_drawn_before_and_after(study: Path, edit: Edit) -> None:
    for number, seed in enumerate((10, 11, 12)):
        folder = study / f"much/{seed}/evaluations/heavy"
        edit(folder / "provenance.json", lambda content: content.update(program="cartpole-finetune"))
        stages = {"before": {MEASURE: {"mean": 1.0 + number}}, "after": {MEASURE: {"mean": 5.0 + number}}}
        kept = {"kept": "after" if number else "before"}
        (folder / "comparison.json").write_text(json.dumps(stages | kept))
    (tuned, _), _ = read_groups({"runs": ["quick"]}, MEASURE)
    results = results_of(tuned, MEASURE)
    page = comparison(results, results, {})
    assert "<h2>Comparison, after</h2>" in page
    assert cells(page, results.title) == ["6.0 (5.0 to 7.0)"]
    assert [each.label for each in results.evaluations] == ["before", "after"]
    assert [agent.values for agent in results.agents] == [
        {"before": 1.0, "after": 5.0},
        {"before": 2.0, "after": 6.0},
        {"before": 3.0, "after": 7.0},
    ]
    rejected = "Rejected fine-tunings: quick/friction/much/10/evaluations/heavy. "
    assert any(each.startswith(rejected) for each in results.notes)
    captions = [each.caption for each in Gallery([results]).pictures(results)]
    assert captions == [
        "best: all runs, seed 12, score (6.1) 7.0",
        "worst: all runs, seed 11, score (6.1) 6.0",
        "An episode of the worst agent over time (seed 11)",
    ]


def test_fine_tunings_of_one_agent_are_told_apart_by_their_own_seeds(study: Path, edit: Edit) -> None:
    shutil.copytree(study / "much/10/evaluations/heavy", "agents/10")
    for seed in (10, 11, 12):
        folder = study / f"much/{seed}/evaluations/heavy"
        edit(folder / "provenance.json", lambda content: content.update(program="cartpole-finetune"))
        edit(folder / "config.yaml", lambda content: content.update(run="agents/10"))
        (folder / "comparison.json").write_text("{}")
    (tuned,), _ = read_groups({"runs": ["quick/friction/much/*/evaluations/heavy"]}, MEASURE)
    results = results_of(tuned, MEASURE)
    assert (results.title, results.exclusions) == ("Fine-tunings", ())
    assert [agent.seed_text for agent in results.agents] == [f"{n} (agent 10)" for n in (10, 11, 12)]
    assert [(row["seed"], row["agent_seed"]) for row in run_rows([tuned])] == [(10, 10), (11, 10), (12, 10)]


def test_evaluations_of_a_pretrained_agent_with_other_seeds_are_of_one_agent(study: Path, edit: Edit) -> None:
    for seed in (10, 11, 12):
        file = study / f"much/{seed}/evaluations/heavy/config.yaml"
        edit(file, lambda content: content.update(run="pretrained/medium"))
    results = results_in("quick/friction/*/*/evaluations/heavy")
    (agent,) = (agent for agent in results.agents if "much" in agent.run)
    assert (agent.run, agent.seed_text) == ("quick/friction/much/10/evaluations/heavy", "–")
    label = results.groups[1].label
    assert [each.reason for each in results.exclusions] == [f"the agent of {label} is there twice"] * 2
    assert not [note for note in results.notes if "lacks" in note]


def test_agents_of_a_training_are_compared_in_pairs_on_two_carts(study: Path, edit: Edit) -> None:
    for seed in (10, 11, 12):
        shutil.copytree(study / f"little/{seed}/evaluations/heavy", f"agents/{seed}")
        for arm in ("little", "much"):
            file = study / f"{arm}/{seed}/evaluations/heavy/config.yaml"
            edit(file, lambda content, seed=seed: content.update(run=f"agents/{seed}"))

    def compared(second: str) -> str:
        sets = {"runs": ["quick/friction/little/*/evaluations/heavy"], "compare": [second]}
        sweeps, between = read_groups(sets, MEASURE)
        assert between is not None
        return comparison(*(results_of(sweep, MEASURE) for sweep in sweeps), between)

    page = compared("quick/friction/much/*/evaluations/heavy")
    assert cells(page, "agents") == ["3, paired"]
    assert cells(page, "chance that compare is higher") == ["0 (0 to 0)"]
    assert cells(compared("quick/friction/much/1[01]/evaluations/heavy"), "agents") == ["3 and 2, unpaired"]
    for file in study.glob("*/*/evaluations/heavy/provenance.json"):  # lost agents of one path
        edit(file, lambda content, file=file: content.update(agent_sha256=file.parts[3]))
        edit(file.with_name("config.yaml"), lambda content: content.update(run="agents/lost"))
    assert cells(compared("quick/friction/much/*/evaluations/heavy"), "agents") == ["3, paired"]
    lost = "The runs of 3 agents were not found and are not checked."
    assert lost in results_in("quick/friction/*/*/evaluations/heavy").notes
