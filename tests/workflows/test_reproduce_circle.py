"""Runs that need each other fail; a study with such runs ends (`workflows/reproduce/reproduce.py`)."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.workflows.reproduce.plan import Task
from cartpole_rl.workflows.reproduce.reproduce import Schedule, reproduce

STUDY: dict[str, Any] = {
    "title": "Circle",
    "order": 1,
    "question": "Which comes first?",
    "command": "finetune",
    "arms": [
        {"name": "hen", "label": "hen", "overrides": ["run={runs}/circle/egg/{seed}"]},
        {"name": "egg", "label": "egg", "overrides": ["run={runs}/circle/hen/{seed}"]},
    ],
    "evaluations": [{"name": "own", "label": "own"}],
    "sizes": {"quick": {"seeds": 1}},
}


@pytest.mark.timeout(120)  # it would never end
def test_runs_that_need_each_other_fail(tmp_path: Path) -> None:
    (tmp_path / "circle.yaml").write_text(yaml.safe_dump(STUDY))
    lines: list[str] = []
    failures = reproduce(["circle"], "quick", tmp_path / "quick", 1, tmp_path, lines.append)
    runs = tmp_path / "quick/circle"
    assert failures == {
        "circle/hen/10": f"it needs {runs}/egg/10; they need each other",
        "circle/egg/10": f"it needs {runs}/hen/10; they need each other",
        "circle/hen/10/evaluations/own": f"it needs {runs}/hen/10, which failed",
        "circle/egg/10/evaluations/own": f"it needs {runs}/egg/10, which failed",
    }
    assert lines[-1].startswith("4 runs in ")


def test_only_the_runs_of_the_circle_need_each_other(tmp_path: Path) -> None:
    def run(name: str, *needs: str) -> Task:
        folders = tuple(tmp_path / need for need in needs)
        return Task("circle", "train", tmp_path / name, tmp_path, (), folders)

    schedule = Schedule([run("a", "b"), run("b", "c"), run("c", "a"), run("d", "a"), run("e", "d")], tmp_path)
    assert schedule.ready(5) == []
    assert [task.folder.name for task, _, _ in schedule.stuck()] == ["a", "b", "c"]
    assert [task.folder.name for task in schedule.waiting] == ["d", "e"]
