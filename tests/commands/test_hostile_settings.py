"""Every command with every group and every setting, and values and files that nobody should give.

Each case gives the right settings, or one line that names what is wrong, exit code 2 and no file.
"""

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from every_command import COMMANDS, GROUPS, REQUIRED, SCHEMAS, contents, required, run, value_at

from cartpole_rl.checking import validated
from cartpole_rl.choices import merged
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError

PATHS = ("run", "resume", "from", "repeat.run", "label", "measure", "runs", "compare")

VALUES: list[Any] = [
    *(True, False, None, -1, 0, 2.5, 1e308, -1e308, 10**400, float("inf"), float("nan")),
    *("", "yes", "1:30", "a b", "#=,[](){}'\"\\$", "é", "${", "\udcff", [], [True], {}, {"a": 1}, [[1]]),
]
WORDS = ("false", "0.66", "1", "1e308", "[1]", "tiny", "a b", "é", "''", "{", "a=b")
WORDS += ("a#b", "null", "[", "a:b")
SETTING_WORDS = (
    *(*WORDS, "true", "yes", "1:30", "-1e308", "{a: {b: [1]}}", "1,2", "range(3)", "${x}", "${oc.env:X}"),
)


def assert_refused(command: str, word: str, folder: Path, named: str) -> None:
    before = contents(folder)
    done, _ = run(command, *required(command), word, folder=folder)
    assert done.code == 2, (command, word, done)
    assert done.complaint.startswith(f"cartpole-{command.replace('_', '-')}: ")
    assert any(part in done.complaint for part in (named, "kind is missing", "belongs to plant")), done
    assert done.out == ""
    assert contents(folder) == before


def turns(command: str) -> Iterator[tuple[int, str]]:
    """Every third group of a command, with its number; the first one depends on the command."""
    groups = [group for other, group in GROUPS if other == command]
    return ((number, group) for number, group in enumerate(groups) if (number + len(command)) % 3 == 0)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_word_that_is_no_choice(command: str, tmp_path: Path) -> None:
    """Every third group gets one of the words, to save time; which ones depends on the command."""
    for number, group in turns(command):
        value = WORDS[(number + len(command)) % len(WORDS)]
        assert_refused(command, f"{group}={value}", tmp_path, group)


FILES: dict[str, tuple[bytes, str]] = {  # content, part of the line
    "twice.yaml": (b"a: 1\na: 2\n", "a is given twice"),
    "self.yaml": (b"defaults: [self.yaml]\n", "extends itself"),
    "circle.yaml": (b"defaults: [self.yaml, circle.yaml]\n", "extends itself"),
    "latin.yaml": (b"a: \xe9\n", "save it as UTF-8"),
    "list.yaml": (b"- a\n", "holds no settings"),
    "cut.yaml": (b"a: [1\n", "not valid YAML, line 1"),
    "number.yaml": (b"1: 2\n", "must be text"),
    "loop.yaml": (b"a: &a [*a]\n", "give numbers, text"),
    "python.yaml": (b"a: !!python/object:x.y {}\n", "not valid YAML"),
    "two.yaml": (b"a: 1\n---\nb: 1\n", "not valid YAML"),
    "others.yaml": (b"defaults: [nothing]\n", "no choice"),
    "defaults.yaml": (b"defaults: 3\n", "defaults is a list"),
    "unknown.yaml": (b"nonsense: 1\n", "nonsense"),
    "null.yaml": (b"\0", "not valid YAML"),
    "key.yaml": (b"? [a]\n: 1\n", "must be text"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_that_is_no_choice(command: str, tmp_path: Path) -> None:
    """Every third group gets one or two of the files, to save time."""
    for name, (content, _) in FILES.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.yaml").mkdir()
    named = {name: part for name, (_, part) in FILES.items()}
    named |= {"folder.yaml": "is a folder", "no.yaml": "no such"}
    for number, group in turns(command):
        for name in [*named][(number + len(command)) % 12 :: 12]:
            assert_refused(command, f"{group}={name}", tmp_path, named[name])


def keys(tree: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """The dotted names of all groups and settings."""
    for name, value in tree.items():
        yield f"{path}{name}"
        if isinstance(value, dict):
            yield from keys(value, f"{path}{name}.")


@pytest.mark.parametrize("command", SCHEMAS)
def test_each_setting_takes_a_value_or_refuses_it_in_one_line(command: str) -> None:
    """Found as given; a truth value is no number. Each setting takes a third of the values."""
    schema, base = SCHEMAS[command], compose(command, REQUIRED.get(command, {}))
    lines: list[str] = []
    for number, key in enumerate(keys(base)):
        for value in VALUES[(number + len(command)) % 3 :: 3]:
            given: Any = value
            for name in reversed(key.split(".")):
                given = {name: given}
            replaced = merged(base, given)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    config = validated(schema, replaced)
            except ConfigError as error:
                lines.append(str(error))
                continue
            kept = value_at(config, tuple(key.split(".")))
            if isinstance(value, bool) or (isinstance(value, int | float) and key not in PATHS):
                assert type(kept) is bool or not isinstance(value, bool), (key, value, kept)
                assert kept == value, (key, value, kept)
    assert [line for line in lines if len(line.splitlines()) != 1] == []


@pytest.mark.parametrize("command", SCHEMAS)
def test_settings_on_the_command_line(command: str, tmp_path: Path) -> None:
    """A twelfth of the words on each command, to save time, each on another setting."""
    settings = [*keys(compose(command, REQUIRED.get(command, {})))]
    for number, value in enumerate(SETTING_WORDS[[*SCHEMAS].index(command) % 12 :: 12]):
        word = f"{settings[7 * number % len(settings)]}={value}"
        done, config = run(command, *required(command), word, folder=tmp_path)
        assert done.code in (0, 2), (word, done)
        assert done.out == "", (word, done)
        assert (config is None) == (done.code == 2), (word, done)
        assert len(done.err.splitlines()) == (done.code == 2), (word, done)
        assert contents(tmp_path) == [], (word, done)
