"""The scripts that install something say what they do before they install anything."""

import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


def run(name: str, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([SCRIPTS / name, *words], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("option", ["--help", "-h"])
@pytest.mark.parametrize("name", ["demo", "install", "test"])
def test_help_prints_the_usage(name: str, option: str) -> None:
    done = run(name, option)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"scripts/{name}" in done.stdout


@pytest.mark.parametrize(
    "words",
    [
        ("install",),
        ("install", "--cpu"),
        ("install", "--gpu"),
        ("install", "--cpu", "--help"),
        ("install", "emulator", "dev"),
        ("test", "--fast"),
    ],
    ids=" ".join,
)
def test_other_options_are_refused_with_the_usage(words: tuple[str, ...]) -> None:
    done = run(*words)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Usage: scripts/" in done.stderr
