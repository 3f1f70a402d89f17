"""Every path of docs/extending.md leads where the page says, in a copy of the package."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from extended_package import EFFECTS
from extending_page import PAGE, ROOT, paths

BIN = Path(sys.executable).parent
PATHS = paths()


def test_the_page_has_the_six_paths() -> None:
    assert set(PATHS) == set(EFFECTS) == set(range(1, 7))
    assert all(path.steps and path.checks for path in PATHS.values())


def test_every_file_of_the_table_is_there() -> None:
    table = PAGE.split("\nThe floors")[0]
    names = re.findall(r"`((?:conf|cartpole_rl)/[^`<>]*)`", table)
    assert len(names) > 20
    assert [name for name in names if not (ROOT / name).exists()] == []


def assert_tidy(folder: Path, files: set[str]) -> None:
    """Ruff sorts the imports and sets the blank lines of the changed files, and has nothing else to say."""
    changed = [file for file in files if file.endswith(".py")]
    for command in (["format"], ["check", "--fix"]) if changed else ():
        done = subprocess.run(
            [BIN / "ruff", *command, "--no-cache", *changed], cwd=folder, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr


def changed_copy(number: int, folder: Path) -> None:
    """Copy the package to `folder`, and apply the steps of a path."""
    for name in ("cartpole_rl", "conf", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    for step in PATHS[number].steps:
        step.apply(folder)


each_path = pytest.mark.parametrize("number", PATHS, ids=lambda number: PATHS[number].title)


@each_path
def test_every_step_finds_its_place(number: int, tmp_path: Path) -> None:
    changed_copy(number, tmp_path)
    assert_tidy(tmp_path, {step.file for step in PATHS[number].steps})


@pytest.mark.nightly
@each_path
def test_path(number: int, tmp_path: Path) -> None:
    changed_copy(number, tmp_path)
    done = subprocess.run(
        [sys.executable, ROOT / "tests/support/extended_package.py", str(number), tmp_path],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=250,
    )
    assert done.returncode == 0, done.stdout + done.stderr
