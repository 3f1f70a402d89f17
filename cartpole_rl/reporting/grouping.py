"""Groups of runs by the settings that differ, under short labels: "pole=large, learning.carts=512"."""

import json
from collections import Counter
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from cartpole_rl.choices import group_choices
from cartpole_rl.reporting.runs import shared_settings

MOST_NAMED = 8  # settings in a label
# fitted from other settings, or what a person gave of an emulated cart: the last to be named
DERIVED = ("guard.numbers", "agent.guard.numbers", "emulator.given")
SOURCE = "source"  # of an agent whose run is not there: "pretrained/medium"
AGENT = "agent"  # prefix of the settings of the agent that a run evaluates
FREELY_LEFT_OUT = "episodes"  # left out of labels where other settings determine it, whoever chose it
ALL = "all runs"  # label where no setting differs
NULL, DEFAULT = "null", "default"  # a setting without a value; the label of a group that has only such

ABSENT = object()  # the settings of an agent whose run is not there
Tree = Mapping[str, Any]
Columns = dict[str, list[str]]  # setting: its value in every run


def setting_columns(trees: Sequence[Tree], words: Sequence[Mapping[str, str]] = ()) -> Columns:
    """Return the settings that differ among runs, each with its value in every run.

    A group of conf/ is named by its choice if all runs have one: "randomization" with values like "wide".
    `words` name the groups of each run that are files of a user. Agents whose runs are not there have SOURCE
    alone: none of their settings differs.
    """
    columns: Columns = {}
    for group in dict.fromkeys(group for tree in trees for group in _groups(tree)):
        named = {
            id(content): each[group]
            for tree, each in zip(trees, words, strict=False)
            if group in each and (content := _subtree(tree, group)) is not None
        }
        columns |= _columns_of(group, [_subtree(tree, group) for tree in trees], named)
    return columns


def fewest(columns: Columns, chosen: Collection[str]) -> Columns:
    """Return the columns that tell the groups of runs apart, those that a person chose to set first.

    A setting that nobody chose is left out if the others determine it, and so is a group of conf/.
    """
    first = [name for name in columns if name in chosen]
    derived = [name for name in columns if name.startswith(DERIVED) and name not in first]
    others = [name for name in columns if name not in (*first, *derived)]
    kept = {name: columns[name] for name in (*first, *others, *derived)}
    for name in (*derived, *reversed(others), *(name for name in first if _may_be_left_out(name))):
        rest = [values for other, values in kept.items() if other != name]
        if rest and len({*zip(*rest, strict=True)}) == len({*zip(*kept.values(), strict=True)}):
            del kept[name]
    return kept


def labels(columns: Columns, count: int) -> list[str]:
    """Return the label of each of `count` runs; a setting is named by its last part if that is unique.

    Above MOST_NAMED settings the others become a number: "variant 3". A choice of conf/ or an agent that is
    all that a label holds stands alone, as "wide", if labels stay apart.
    """
    lasts = Counter(name.rpartition(".")[2] for name in columns)
    short = {name: last if lasts[last := name.rpartition(".")[2]] == 1 else name for name in columns}
    named, others = [*columns][:MOST_NAMED], [*columns][MOST_NAMED:]
    rests = [tuple(columns[name][row] for name in others) for row in range(count)]
    numbers = {rest: number for number, rest in enumerate(dict.fromkeys(rests), start=1)}
    parts = (
        [
            *(f"{short[name]}={columns[name][row]}" for name in named if columns[name][row] != NULL),
            *([f"variant {numbers[rests[row]]}"] if others else []),
        ]
        for row in range(count)
    )
    whole = [*parts]
    short_ones = [[_word(each[0])] if len(each) == 1 else each for each in whole]
    chosen = short_ones if len({*map(tuple, short_ones)}) == len({*map(tuple, whole)}) else whole
    return [", ".join(each) or (DEFAULT if columns else ALL) for each in chosen]


def _word(part: str) -> str:
    """Return the value of "randomization=wide", and other parts of a label as they are."""
    name, _, value = part.partition("=")
    return value if name == SOURCE or _choices(name) else part


def _may_be_left_out(name: str) -> bool:
    return name == FREELY_LEFT_OUT or bool(_choices(name.removeprefix(f"{AGENT}.")))


def _group(name: str) -> str:
    """Return the group of conf/ that a setting belongs to; "agent.pole" for the agent of an evaluation."""
    parts = name.split(".")
    return ".".join(parts[:2] if parts[0] == AGENT and len(parts) > 2 else parts[:1])


def _groups(tree: Tree) -> Iterator[str]:
    """Yield the groups of conf/ that a tree has settings of."""
    for name, content in tree.items():
        yield name
        if name == AGENT and isinstance(content, Mapping):
            yield from (f"{name}.{inner}" for inner in content if isinstance(content[inner], Mapping))


def _columns_of(group: str, contents: Sequence[Any], named: Mapping[int, str]) -> Columns:
    """Return the columns of one group, of which runs have `contents`: its choices, or its settings.

    Runs share what was read once: every object is looked at once. `named` names some of them by their ids.
    """
    distinct = {id(content): content for content in contents if content is not ABSENT}
    if len(distinct) < 2:
        return {}
    settings = {key: _settings_of(group, content) for key, content in distinct.items()}
    every = dict.fromkeys(name for each in settings.values() for name in each)
    names = [name for name in every if len({each.get(name) for each in settings.values()}) > 1]
    short = group.rpartition(".")[2]
    chosen = {
        key: NULL if content is None else _choice(short, content) or named.get(key)
        for key, content in distinct.items()
    }
    texts = {key: json.dumps(content, sort_keys=True, default=str) for key, content in distinct.items()}
    if (
        names
        and all(chosen.values())
        and len({(chosen[key], texts[key]) for key in distinct}) == len({*chosen.values()})
    ):
        return {group: [str(chosen.get(id(content), NULL)) for content in contents]}
    found = [settings.get(id(content), {}) for content in contents]
    return {name: _texts([each.get(name) for each in found]) for name in names}


def _settings_of(group: str, content: Any) -> dict[str, Hashable]:
    """Return the settings by dotted name of a group, without those of the groups within."""
    tree = {group: content} if content is not None else {}
    return {name: value for name, value in shared_settings(tree).items() if _group(name) == group}


def _subtree(tree: Tree, group: str) -> Any:
    if group.startswith(AGENT) and SOURCE in tree:
        return ABSENT
    found: Any = tree
    for part in group.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _choice(group: str, content: Any) -> str | None:
    """Return the choice of `group` that has this content, ignoring values that are None in the choice."""
    if not isinstance(content, Mapping):
        return None
    return next((name for name, choice in _choices(group).items() if _is_choice(choice, content)), None)


@cache
def _choices(group: str) -> dict[str, dict[str, Any]]:
    return group_choices(group) if group.isidentifier() else {}


def _is_choice(choice: Any, content: Any) -> bool:
    if isinstance(choice, Mapping) and isinstance(content, Mapping):
        given = {name: value for name, value in choice.items() if value is not None}
        others = {name for name, value in content.items() if value not in (None, {})} - {*choice}
        same = all(_is_choice(value, content.get(name)) for name, value in given.items())
        return (
            same
            and (bool(given) or not others)
            and not any(isinstance(content[name], Mapping) for name in others)
        )
    return bool(choice == content)


def _texts(values: Sequence[Hashable]) -> list[str]:
    """Return the values as text, numbers with the digits that tell them apart."""
    short = [_text(value, "g") for value in values]
    return short if len({*short}) == len({*values}) else [_text(value, "") for value in values]


def _text(value: Hashable, form: str) -> str:
    if value is None:
        return NULL
    return format(value, form) if isinstance(value, float) else str(value)
