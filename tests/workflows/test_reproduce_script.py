"""scripts/reproduce names folders as its caller does, and reports the mistakes of the system in one line."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

CHECKOUT = Path(__file__).parents[2]
SCRIPT = CHECKOUT / "scripts/reproduce.py"
STUDY = {
    "title": "Baseline",
    "order": 1,
    "question": "Does it run?",
    "arms": [{"name": "lqr", "label": "energy and LQR", "overrides": ["run=lqr"]}],
    "sizes": {"quick": {"seeds": 1, "evaluation_overrides": ["episodes=1"]}},
}


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """scripts/reproduce.py as a module."""
    spec = importlib.util.spec_from_file_location("reproduce_script", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def caller(tmp_path: Path) -> Path:
    """A folder that holds a folder of studies."""
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/baseline.yaml").write_text(yaml.safe_dump(STUDY))
    return tmp_path


def reproduce(caller: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    """scripts/reproduce of a caller in a folder."""
    return subprocess.run([sys.executable, SCRIPT, *words], cwd=caller, capture_output=True, text=True)


def test_folders_are_those_of_the_caller(caller: Path) -> None:
    done = reproduce(caller, "--studies", "studies", "--folder", "my #runs")
    assert (done.returncode, done.stderr) == (0, "")
    assert (caller / "my #runs/quick/baseline/lqr/10/metrics.json").exists()
    page = f'''studies='"{caller}/my #runs/quick"\''''
    assert done.stdout.splitlines()[-1] == f"the page: cartpole-report {page}"


def test_a_folder_in_the_checkout_has_one_name_from_everywhere(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for here, path, name in (
        (CHECKOUT, "runs/x", Path("runs/x")),
        (CHECKOUT / "docs", "x", Path("docs/x")),
        (tmp_path, "x", tmp_path / "x"),
        (tmp_path, f"{CHECKOUT}/x", CHECKOUT / "x"),
    ):
        monkeypatch.chdir(here)
        assert script.as_in_checkout(path) == name


def test_the_results_are_in_the_checkout_by_default(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["scripts/reproduce"])
    assert script.parse_options().folder == Path("runs/reproduce")


def test_the_shell_script_stays_in_the_folder_of_the_caller(tmp_path: Path) -> None:
    copy, python = tmp_path / "checkout/scripts/reproduce", tmp_path / "checkout/.venv/bin/python"
    for file in (copy, python):
        file.parent.mkdir(parents=True)
    shutil.copy(CHECKOUT / "scripts/reproduce", copy)
    python.write_text('#!/bin/sh\npwd\necho "$@"\n')
    python.chmod(0o755)
    done = subprocess.run([copy, "--list"], cwd="/", capture_output=True, text=True)
    assert done.stdout.splitlines() == ["/", f"{copy}.py --list"]


def test_a_folder_that_cannot_be_made_is_one_line(caller: Path) -> None:
    (caller / "file").touch()
    done = reproduce(caller, "--studies", "studies", "--folder", "file/runs")
    assert done.stderr == f"scripts/reproduce: {caller}/file/runs/quick: Not a directory\n"
    assert done.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full is a device of Linux")
def test_a_full_disk_is_one_line(caller: Path) -> None:
    command = [sys.executable, SCRIPT, "--studies", "studies", "--folder", "runs"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, cwd=caller, stdout=full, stderr=subprocess.PIPE, text=True)
    remedy = "make room, then give the same command again"
    assert done.stderr == f"scripts/reproduce: No space left on device; {remedy}\n"
    assert done.returncode == 1
