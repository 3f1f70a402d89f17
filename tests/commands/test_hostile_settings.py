"""Every command with every group and every setting, and values and files that nobody should give.

Each case gives the right settings, or one line that names what is wrong, exit code 2 and no file.
"""

import contextlib
import io
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import yaml
from command_line import HANDLED, Outcome
from hydra.core.global_hydra import GlobalHydra

from cartpole_rl.checking import checked
from cartpole_rl.choices import default_choices, group_choices, merged
from cartpole_rl.cli import VERBS
from cartpole_rl.command import provide_config, run_command
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings

SCHEMAS: dict[str, type[Settings]] = {name: verb.find(verb.settings) for name, verb in VERBS.items()}
REQUIRED: dict[str, dict[str, Any]] = {
    "evaluate": {"run": "lqr"},
    "record": {"run": "lqr"},
    "finetune": {"run": "some"},
    "model": {"from": "some"},
    "replay": {"from": "some"},
    "preflight": {"plant.port": "auto"},
    "export": {"run": "some", "format": "c"},
    "distill": {"run": "some"},
    "report": {"runs": ["some"]},
}
NOT_ALONE = {"sweep"}  # a sweep makes jobs; those of the package are in test_sweeps.py
GROUPS = [
    (command, group) for command in SCHEMAS for group in default_choices(command) if group not in NOT_ALONE
]
PATHS = ("run", "resume", "from", "repeat.run", "label", "measure", "runs", "compare")

VALUES: list[Any] = [
    *(True, False, None, -1, 0, 2.5, 1e308, -1e308, 10**400, float("inf"), float("nan")),
    *("", "yes", "1:30", "a b", "#=,[](){}'\"\\$", "é", "${", "\udcff", [], [True], {}, {"a": 1}, [[1]]),
]
WORDS = (
    "false",
    "0.66",
    "1",
    "1e308",
    "[1]",
    "tiny",
    "a b",
    "é",
    "''",
    "{",
    "a=b",
    "a#b",
    "null",
    "[",
    "a:b",
)
SETTING_WORDS = (
    *WORDS,
    "true",
    "yes",
    "1:30",
    "-1e308",
    "{a: {b: [1]}}",
    "1,2",
    "range(3)",
    "${x}",
    "${oc.env:X}",
)


def run(command: str, *words: str, folder: Path) -> tuple[Outcome, Settings | None]:
    """Compose and check a command's settings as the command does; return the outcome and the settings."""
    found: list[Settings] = []

    verb = VERBS[command]._replace(function=lambda config: found.append(config), check="")

    GlobalHydra.instance().clear()
    handlers = {number: signal.getsignal(number) for number in HANDLED}
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        patch.object(sys, "argv", [f"cartpole-{command}", *words]),
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error", RuntimeWarning)
        try:
            run_command(command, verb)
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return Outcome(code, out.getvalue(), err.getvalue()), found[0] if found else None


def required(command: str) -> list[str]:
    """The words without which a command does not start."""
    return [f"{key}={value}".replace("'", "") for key, value in REQUIRED.get(command, {}).items()]


def contents(folder: Path) -> list[str]:
    return sorted(os.fsencode(path).decode(errors="replace") for path in folder.rglob("*"))


def assert_refused(command: str, word: str, folder: Path, named: str) -> None:
    before = contents(folder)
    done, _ = run(command, *required(command), word, folder=folder)
    assert done.code == 2, (command, word, done)
    assert done.complaint.startswith(f"cartpole-{command.replace('_', '-')}: ")
    assert any(part in done.complaint for part in (named, "kind is missing", "belongs to plant")), done
    assert done.out == ""
    assert contents(folder) == before


@pytest.mark.parametrize(("command", "group"), GROUPS)
def test_a_word_that_is_no_choice(command: str, group: str, tmp_path: Path) -> None:
    for value in WORDS[len(command + group) % 3 :: 3]:  # a third, to save time
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


@pytest.mark.parametrize(("command", "group"), GROUPS)
def test_a_file_that_is_no_choice(command: str, group: str, tmp_path: Path) -> None:
    for name, (content, _) in FILES.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.yaml").mkdir()
    for name, (_, named) in {
        **FILES,
        "folder.yaml": (b"", "is a folder"),
        "no.yaml": (b"", "no such"),
    }.items():
        assert_refused(command, f"{group}={name}", tmp_path, named)


KINDS = {  # of files that are right: name, and what is done with the text
    "named like a shipped choice": ("{shipped}.yaml", str.encode),
    "in a folder": ("deep/{shipped}.yaml", str.encode),
    "with a byte order mark": ("mine.yaml", lambda text: text.encode("utf-8-sig")),
    "of Windows": ("mine.yaml", lambda text: text.replace("\n", "\r\n").encode()),
    "with odd characters": ("a b,c#d=e[f](g){h}é'.yaml", str.encode),
    "named like a value": ("true.yaml", str.encode),
    "named like a number": ("1.5.yaml", str.encode),
    "in an odd folder": ("a b,c=#é/mine.yaml", str.encode),
    "with a short suffix": ("mine.yml", str.encode),
}


def numbers(tree: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], float]]:
    """The positive floats in a tree."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from numbers(value, (*path, name))
        elif isinstance(value, float) and value > 0:
            yield (*path, name), value


def own_choice(command: str, group: str) -> tuple[str, dict[str, Any], tuple[str, ...], float | None]:
    """A shipped choice of a group, a file that changes a number of it, and where the number is found."""
    default = choice_of(command, group)
    if group == "experiment":
        return default, {"defaults": [default], "seed": 7}, ("seed",), 7
    if group == "emulator":
        return default, {"defaults": [default], "cart_viscous": 0.77}, (group, "cart_viscous"), 0.77
    found = next(numbers(group_choices(group)[default]), None)
    if found is None:
        return default, {"defaults": [default]}, (), None
    path, value = found
    changed: Any = round(0.99 * value, 12)
    number = changed
    for name in reversed(path):
        changed = {name: changed}
    return default, {"defaults": [default], **changed}, (group, *path), number


def choice_of(command: str, group: str) -> str:
    """The default choice of a group, or its first."""
    return default_choices(command)[group] or next(iter(group_choices(group)))


def value_at(config: Settings, path: tuple[str, ...]) -> Any:
    value: Any = config.model_dump(by_alias=True)
    for name in path:
        value = value[name]
    return value


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", sorted({command for command, _ in GROUPS}))
def test_files_of_all_groups_are_found_in_the_settings(command: str, kind: str, tmp_path: Path) -> None:
    words, expected = required(command), {}
    name, encoded = KINDS[kind]
    for group in (group for other, group in GROUPS if other == command):
        if command in ("evaluate", "record", "preflight") and group == "emulator":
            continue  # their plant does not read it
        shipped, content, path, number = own_choice(command, group)
        file = tmp_path / group / name.replace("{shipped}", shipped)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(encoded(yaml.safe_dump(content)))
        words.append(f"{group}={file}")
        if number is not None:
            expected[path] = number
    before = contents(tmp_path)
    done, config = run(command, *words, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    assert config is not None
    assert {path: value_at(config, path) for path in expected} == expected
    assert contents(tmp_path) == before


def keys(tree: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """The dotted names of all groups and settings."""
    for name, value in tree.items():
        yield f"{path}{name}"
        if isinstance(value, dict):
            yield from keys(value, f"{path}{name}.")


@pytest.mark.parametrize("command", SCHEMAS)
def test_each_setting_takes_a_value_or_refuses_it_in_one_line(command: str) -> None:
    """The settings are found as given; a truth value is no number, and a refusal names the setting."""
    schema = SCHEMAS[command]
    provide_config(command, schema)
    base = compose(command, REQUIRED.get(command, ()))
    lines: list[str] = []
    for key in keys(base):
        for value in VALUES:
            given: Any = value
            for name in reversed(key.split(".")):
                given = {name: given}
            replaced = merged(base, given)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    config = checked(schema, replaced)
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
    """Half of the words on each command, to save time, each on another setting."""
    provide_config(command, SCHEMAS[command])
    settings = [*keys(compose(command, REQUIRED.get(command, ())))]
    for number, value in enumerate(SETTING_WORDS[len(command) % 2 :: 2]):
        word = f"{settings[7 * number % len(settings)]}={value}"
        done, config = run(command, *required(command), word, folder=tmp_path)
        assert done.code in (0, 2), (word, done)
        assert done.out == "", (word, done)
        assert (config is None) == (done.code == 2), (word, done)
        assert len(done.err.splitlines()) == (done.code == 2), (word, done)
        assert contents(tmp_path) == [], (word, done)
