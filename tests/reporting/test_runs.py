"""One damaged run is named with its problem; no damage stops a report."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.reporting.runs import (
    Run,
    find_runs,
    learning_curve,
    measured,
    partly_measured_note,
    read_run,
)
from cartpole_rl.run_folder import file_hash

Edit = Callable[[Path, Callable[[Any], object]], None]
GOOD = '{"transitions": 1, "score": 2.0}\n{"transitions": 2, "score": 3.0}\n'


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("provenance.json", '{"program": "cartpole-evaluate", "packages": ["a"]}', "damaged: 'list' object"),
        ("provenance.json", '{"program": "cartpole-evaluate", "git_commit": 5}', "damaged: 'int' object"),
        ("metrics.json", "[" * 200_000, "damaged results: maximum recursion depth"),
        ("metrics.json", '{"episodes": 2}', "damaged results: its episodes are no list"),
        ("metrics.json", '{"episodes": "ab"}', "damaged results: its episodes are no list"),
        ("config.yaml", "a: &a {b: *a}\n", "damaged: maximum recursion depth"),
        ("config.yaml", "a: &a [*a]\n", "damaged: Circular reference"),
        ("config.yaml", "run: 5\n", "damaged: run in config.yaml is no path"),
        ("config.yaml", "seed: x\n", "damaged: seed in config.yaml is no number"),
        ("config.yaml", "seed: true\n", "damaged: seed in config.yaml is no number"),
        ("inputs.json", "[" * 200_000, "damaged results: maximum recursion depth"),
    ],
)
def test_damage_is_the_problem_of_its_run(name: str, text: str, problem: str, study: Path) -> None:
    folder = study / "much/11/evaluations/heavy"
    assert read_run(folder).problem == ""
    (folder / name).write_text(text)
    assert read_run(folder).problem.startswith(problem)


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\nb:\n- 2\n- c: 3\n",
        "# a comment\na: 1\n",
        "a: &one [1]\nb: *one\n",
        "a: {x: 1,\n y: 2}\n\nb: |\n  c: 3\n",
        "a: 'x\n\n  b: 3'\nc: 4\n",
        "a: 1\na: 2\n",
        '"a": 1\nb: 2\n',
    ],
)
def test_settings_are_those_of_the_whole_file(text: str, study: Path) -> None:
    folder = study / "much/11/evaluations/heavy"
    (folder / "config.yaml").write_text(text)
    assert read_run(folder).config == yaml.safe_load(text)


def test_runs_share_the_settings_that_are_the_same(study: Path) -> None:
    first, second = (read_run(study / f"much/{seed}/evaluations/heavy") for seed in (10, 11))
    assert first.config["seed"] != second.config["seed"]
    assert first.config["emulator"] is second.config["emulator"]


def test_a_run_that_was_resumed_with_other_versions_has_both(study: Path, edit: Edit) -> None:
    folder = study / "much/11/evaluations/heavy"
    first = read_run(folder)
    later = {"packages": {"torch": "9.9"}, "git_commit": "b" * 40}
    edit(folder / "provenance.json", lambda content: content.update(resumed=[later, later]))
    run = read_run(folder)
    assert run.versions == f"{first.versions}, then torch 9.9"
    assert run.commit.endswith(" then bbbbbbbbbb")
    edit(folder / "provenance.json", lambda content: content.update(resumed=[5]))
    assert read_run(folder).problem.startswith("damaged: 'int' object")


def test_an_evaluation_of_an_earlier_checkpoint_does_not_count(study: Path, edit: Edit) -> None:
    folder, checkpoint = study / "much/11/evaluations/heavy", Path("agent/checkpoints/last.pt")
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(b"half trained")
    used = file_hash(checkpoint)
    edit(folder / "config.yaml", lambda content: content.update(run="agent"))
    edit(folder / "provenance.json", lambda content: content.update(agent_sha256=used))
    assert read_run(folder).problem == ""
    checkpoint.write_bytes(b"trained")
    assert read_run(folder).problem == "its agent agent has another checkpoint now; repeat it"
    beside = study / "agent/checkpoints/last.pt"  # the runs were moved, the agent with them
    beside.parent.mkdir(parents=True)
    beside.write_bytes(b"half trained")
    assert read_run(folder).problem == ""
    beside.unlink()
    checkpoint.unlink()
    assert read_run(folder).problem == ""


def test_a_run_that_failed_shows_the_end_of_its_log(study: Path, edit: Edit) -> None:
    folder = study / "much/11/evaluations/heavy"
    (folder / "log.txt").write_text("starting\nno space left\n\n")
    assert read_run(folder).problem == ""
    (folder / "metrics.json").unlink()
    assert (
        read_run(folder).problem == "unfinished: it has no metrics.json; its log.txt ends with: no space left"
    )
    edit(folder / "provenance.json", lambda content: content.update(program="cartpole-replay"))
    assert read_run(folder).problem == "a run of cartpole-replay, which a report does not show"


def test_a_failed_job_says_why(study: Path) -> None:
    folder = study / "much/11/evaluations/heavy"
    (folder / "error.txt").write_text("cart_mass=-1: give more than 0\nTraceback\n")
    assert read_run(folder).problem == ""  # it has results
    (folder / "metrics.json").unlink()
    assert read_run(folder).problem == "failed: cart_mass=-1: give more than 0"
    (folder / "config.yaml").unlink()
    assert read_run(folder).problem == "failed: cart_mass=-1: give more than 0"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (GOOD + '{"transitions": 3, "sc', 3),
        ("5\n6\n", 1),
        ('"score"\n', 1),
        ('{"score": 1}\n', 1),
        ('{"transitions": 1, "score": NaN}\n', 1),
    ],
)
def test_a_damaged_history_is_named_by_its_line(text: str, line: int, tmp_path: Path) -> None:
    assert learning_curve(tmp_path, "score") == ("score", [])
    (tmp_path / "history.jsonl").write_text(GOOD)
    assert learning_curve(tmp_path, "steps") == ("score", [(1, 2.0), (2, 3.0)])
    (tmp_path / "history.jsonl").write_text(text)
    with pytest.raises(ValueError, match=rf"^line {line} of history\.jsonl is damaged$"):
        learning_curve(tmp_path, "score")


def test_failed_jobs_and_links_are_found(tmp_path: Path) -> None:
    for name in ("sweep/0", "sweep/1", "elsewhere/run"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "sweep/0/config.yaml").touch()
    (tmp_path / "sweep/1/error.txt").write_text("it failed")
    (tmp_path / "elsewhere/run/config.yaml").touch()
    (tmp_path / "sweep/2").symlink_to(tmp_path / "elsewhere/run")
    (tmp_path / "sweep/3").symlink_to("nowhere")
    (tmp_path / "sweep/loop").symlink_to(tmp_path / "sweep")
    found = {path.name: path for path in find_runs(tmp_path / "sweep")}
    assert {*found} == {"0", "1", "2", "3"}
    assert read_run(found["3"]).problem == "a link to nothing"


def test_an_ending_that_no_episode_had_is_counted_as_0() -> None:
    results = {"ended_by": {"time": 3}, "score": {"mean": 1.0}}
    names = ("ended_by.time", "ended_by.track", "ended_by.bogus", "score", "score.track")
    assert [measured(results, name) for name in names] == [3, 0, None, 1, None]
    assert measured({}, "ended_by.track") is None


def test_a_mean_over_a_part_of_the_episodes_is_noted() -> None:
    def run(count: int) -> Run:
        return Run(Path("x"), results={"time": {"mean": 1.0, "count": count}}, episodes=3)

    assert partly_measured_note([run(3)], "time") == ""
    assert partly_measured_note([run(3), run(1), run(2)], "time") == (
        "time: only 3 of 6 episodes of 2 runs have it; their means are over these episodes."
    )
