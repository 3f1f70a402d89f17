"""Overrides of studies: what YAML, Hydra and the shell make of folders with unusual names."""

import shlex
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from cartpole_rl.workflows.person import as_word
from cartpole_rl.workflows.studies import overrides_of

PLAIN = ["runs/reproduce", "100%", "a:b", "-x", "a+b"]
FOLDERS = [
    *PLAIN,
    *("my runs", "a=b", "a,b", "a #b", "a: b", "é", "[x]", "x]", "{seed}", "it's", "'q'", '"', '\\"', "a\\b"),
    *("~", "*x", "&x", "!x", "- x", "null", "a/../b", "$x", "(x)", "a;b"),
]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_path_below_the_folder_of_all_studies_is_taken_as_it_is(folder: str) -> None:
    root = Path(folder, "quick")
    run = f"{root}/toy/trained/10"
    words = (f"run={run}", f"from=[{run}, {root}/b/c/1]", "episodes=2", "parameters={cart_mass: 1.5}")
    assert overrides_of(words, root) == {
        "run": run,
        "from": [run, f"{root}/b/c/1"],
        "episodes": 2,
        "parameters": {"cart_mass": 1.5},
    }


def test_a_path_that_only_ends_like_one_of_all_studies_is_read_as_before() -> None:
    assert overrides_of(["run=/away/runs/a/b/1"], Path("runs")) == {"run": "/away/runs/a/b/1"}


@pytest.mark.parametrize("folder", FOLDERS)
def test_hydra_reads_the_word_of_a_folder_after_the_shell(folder: str) -> None:
    path = Path(folder, "quick")
    (word,) = shlex.split(as_word("studies", path))
    override = OverridesParser.create().parse_override(word)
    assert not override.is_sweep_override()
    assert override.value() == str(path)


@pytest.mark.parametrize("folder", PLAIN)
def test_a_word_without_special_characters_has_no_quotes(folder: str) -> None:
    assert as_word("studies", Path(folder)) == f"studies={folder}"
