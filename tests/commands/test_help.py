"""Help of every command."""

import re
import shlex
from pathlib import Path

import pytest
from command_line import in_process
from every_command import SCHEMAS

from cartpole_rl import __version__
from cartpole_rl.checking import validated
from cartpole_rl.choices import conf_folder
from cartpole_rl.cli import main
from cartpole_rl.composition import compose

WITHOUT_A_SETTING = {"train": {"experiment", "sweep"}}  # groups that set other groups, or what is swept


def examples(text: str) -> list[list[str]]:
    """The words of each example on a page of --help, without what it explains."""
    _, _, below = text.partition("Examples\n")
    lines = [line.strip() for line in below.partition("\n\n")[0].splitlines()]
    return [shlex.split(re.split(r" {3,}", line)[0]) for line in lines if line.startswith("cartpole-")]


@pytest.mark.parametrize("command", SCHEMAS)
def test_help(command: str, tmp_path: Path) -> None:
    """The groups shown fill fields of the settings, three examples compose, and the pages named exist."""
    name = f"cartpole-{command.replace('_', '-')}"
    done = in_process(command, "--help", folder=tmp_path)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"{name} ")
    groups = {path.name for path in conf_folder().iterdir() if path.is_dir()}
    shown = {line.partition(":")[0].strip() for line in done.out.splitlines() if re.match(r"  \w+: \w", line)}
    expected = SCHEMAS[command].model_fields.keys() | WITHOUT_A_SETTING.get(command, set())
    assert shown & groups == groups & expected
    pages = re.findall(r"docs/[\w-]+\.md", done.out)
    assert pages
    assert [page for page in pages if not Path(conf_folder().parent, page).is_file()] == []
    found = examples(done.out)
    assert len(found) == 3
    for program, *words in found:
        assert program == name
        one_job = "-m" in words
        words = [word.partition(",")[0] if one_job else word for word in words if word != "-m"]
        validated(SCHEMAS[command], compose(command, words))
    assert not list(tmp_path.iterdir())


def test_version_is_that_of_the_package(tmp_path: Path) -> None:
    done = in_process("train", "--version", folder=tmp_path)
    assert (done.code, done.out) == (0, f"cartpole_rl {__version__}\n")


def test_a_wrong_verb_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["cartpole", "trian"])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("cartpole: trian: there is no such verb; did you mean train? there are train, ")
