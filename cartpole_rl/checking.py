"""Checks settings given as plain data. The message names each wrong key and the remedy."""

import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, get_args

from pydantic import ValidationError

from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings

# the tags of unions, which pydantic adds to a key
TAGS = re.compile(
    r"(?<=^plant)\.(simulated|emulated|serial|text|driver|learned)(?=\.|$)"
    r"|(?<=^learner)\.(local|ray)(?=\.|$)|(?<=^randomization)\.(ranges|identified)(?=\.|$)"
    r"|(?<=^emulator\.cart)\.(str|dict\[[^]]*\])(?=\.|$)"
    r"|\.literal\[[^]]*\]$|\.constrained-float$|(?<=\.wraps)\.bool$"
)
NEAR = 0.8  # similarity of two names, 0 to 1, from which one is suggested for the other
NEAR_VALUE = 0.6  # similarity from which a value is suggested
MOST_NAMES = 12  # of a group that a message lists
SAME_GROUP = 0.15  # added to the similarity within one group
NAMELESS = "pole: the numbers of a pole stand under its name: choices: {mine: {pole_mass: ...}}"
SYNONYMS = {"gpu": "cuda"}  # which is spelt more like cpu
EXAMPLES = {  # of required settings
    "run": "run=runs/train/<run> or run=pretrained/medium",
    "format": "format=weights, onnx, c, web, firmware, minari or mcap",
    "from": "from=<file or folder>",
    "plant.port": "plant.port=/dev/ttyUSB0 (cartpole-find-port lists the ports) or plant.port=auto",
    "plant.model": "plant.model=runs/model/<run>",
    "plant.full": "plant.full=<what the board takes at motor value 255>, negative if its motor is reversed",
    "plant.driver": "plant.driver=<module>:<class>",
    "learner.address": "learner.address=<host>:6379, the address of the Ray head",
}
REMEDIES = {  # by pydantic's type of error; the others keep pydantic's text
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "give an integer"),
    **dict.fromkeys(("float_type", "float_parsing"), "give a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "give true or false"),
    **dict.fromkeys(("string_type", "path_type"), "give text"),
    **dict.fromkeys(("dict_type", "model_type"), "give a mapping, as {{name:value}}"),
    **dict.fromkeys(("literal_error", "enum"), "give {expected}"),
    "finite_number": "give a finite number",
    "greater_than": "give more than {gt}",
    "greater_than_equal": "give at least {ge}",
    "less_than": "give less than {lt}",
    "less_than_equal": "give at most {le}",
    "too_short": "give {min_length} or more values",
    "too_long": "give {max_length} or fewer values",
}
IN_SECONDS = (  # ends of the names of settings whose bounds are in seconds
    "timeout",
    "latency",
    "latency_jitter",
    "control_period",
    "duration",
    "time_constant",
    "nudge_after",
    "restart",
)

Config = TypeVar("Config", bound=Settings)


def validated(
    schema: type[Config], values: Mapping[str, Any], source: Callable[[str], str] = lambda key: ""
) -> Config:
    """Return `values` as a `schema`. Raises ConfigError that names each wrong key and the remedy.

    `source` returns what stands before the message about a key, such as the file that gave its value.
    """
    try:
        return schema(**values)
    except ValidationError as error:
        complaints: dict[str, str] = {}
        wrong = tuple(f"{_key(detail)}." for detail in error.errors() if detail["type"] == "extra_forbidden")
        unknown = {name for name in setting_names(values) if f"{name}.".startswith(wrong)}
        for detail in error.errors():
            key = _key(detail)
            if key.startswith("pole.pole_"):
                complaints["pole.pole_"] = f"{source(key)}{NAMELESS}"
            elif key in complaints:  # another member of a union
                complaints[key] += f", or {_reason(detail).removeprefix('give ')}"
            else:
                complaints[key] = f"{source(key)}{_complaint(detail, schema, values, unknown)}"
        raise ConfigError("; ".join(complaints.values())) from None


def _key(detail: Mapping[str, Any]) -> str:
    return TAGS.sub("", ".".join(map(str, detail["loc"])))


def _complaint(
    detail: Mapping[str, Any], schema: type[Settings], values: Mapping[str, Any], unknown: set[str]
) -> str:
    """Return what is wrong; settings that are `unknown` themselves are not meant by others."""
    key = _key(detail)
    match detail["type"]:
        case "extra_forbidden":
            return no_such_setting(key, setting_names(values) - unknown)
        case "missing":
            return missing(key)
        case "union_tag_invalid":  # a plant that this command does not take
            taken = detail["ctx"]["expected_tags"].replace("'", "")
            return f"{key}={detail['ctx']['tag']}: this command takes {taken}"
        case "union_tag_not_found":  # a plant's file without its kind
            known = kinds(schema, key)
            return (
                f"{key}: kind is missing; give {key}={', '.join(known)}, or begin its file with one of them, "
                f"as in `defaults: [{known[-1]}]`"
            )
    given = detail["input"]
    value = json.dumps(given) if given is None or isinstance(given, bool) else given  # as it was typed
    named = f"{key}={value}" if isinstance(value, int | float | str) else key
    return f"{named}: {_reason(detail)}" if key else _reason(detail)


def _reason(detail: Mapping[str, Any]) -> str:
    """Return the remedy for a wrong value, or what is wrong with it."""
    if remedy := REMEDIES.get(detail["type"]):
        limits = {name: _plain(limit) for name, limit in detail.get("ctx", {}).items()}
        is_bound = detail["type"].startswith(("greater", "less"))
        unit = " s" if is_bound and _key(detail).endswith(IN_SECONDS) else ""
        return f"{_meant(detail)}{remedy.format(**limits)}{unit}"
    if detail["type"] == "tuple_type":
        given = detail["input"]
        if "keep" in detail["loc"]:
            return "give the lowest and the highest value, as [0,0.5]"
        return f"give a list, as [{given if isinstance(given, int | float | str) else '0.5,0.02'}]"
    reason: str = detail["msg"].removeprefix("Value error, ")
    return reason[0].lower() + reason[1:] if detail["loc"] else reason


def _meant(detail: Mapping[str, Any]) -> str:
    """Return "did you mean ...? " for a text that is close to one of the expected ones."""
    choices = re.findall(r"'([^']+)'", str(detail.get("ctx", {}).get("expected", "")))
    if not choices or not isinstance(detail["input"], str):
        return ""
    if (meant := SYNONYMS.get(detail["input"])) in choices:
        return f"did you mean {meant}? "
    near = most_similar(detail["input"], choices)
    return f"did you mean {near}? " if similarity(detail["input"], near)[0] >= NEAR_VALUE else ""


def _plain(limit: Any) -> Any:
    """Return a limit as text: 1 for 1.0."""
    return int(limit) if isinstance(limit, float) and limit.is_integer() else limit


def missing(key: str) -> str:
    """Return the message for a required setting that is not given."""
    above, _, last = key.rpartition(".")
    if last.isdecimal():  # in a list
        return f"{above}: value {int(last) + 1} is missing"
    return f"{key} is missing; give {EXAMPLES.get(key, f'{key}=...')}"


def kinds(schema: type[Settings], field: str) -> list[str]:
    """Return the kinds that the setting `field` of `schema` takes; none if it has no such setting."""
    if field not in schema.model_fields:
        return []
    annotation = schema.model_fields[field].annotation
    classes = get_args(annotation) or (annotation,)
    return [kind for each in classes for kind in get_args(each.model_fields["kind"].annotation)]


def no_such_setting(key: str, known: Iterable[str]) -> str:
    """Return the message for an unknown setting, with the most similar name or all names of its group."""
    above, _, wrong = key.rpartition(".")
    known = sorted(known)
    if above == "parameters":
        return f"{key}: numbers of the cart are given together, as 'parameters={{{wrong}:...}}'"

    def similar(setting: str) -> tuple[float, float, bool]:
        place, _, name = setting.rpartition(".")
        ratio, letters = similarity(wrong, name)
        return ratio + SAME_GROUP * (place == above), letters, place == "plant"  # rather than emulator

    nearest = max(known, key=similar, default="")
    beside = [name for place, _, name in (each.rpartition(".") for each in known) if place == above]
    if nearest and similar(nearest)[0] > NEAR:
        hint = f"did you mean {nearest}?"
    elif above and 0 < len(beside) <= MOST_NAMES:
        hint = f"{above} has {', '.join(beside)}"
    else:
        hint = "--cfg job shows the settings"
    return f"{key}: there is no such setting; {hint}"


def of_another_choice(key: str, choices: Sequence[str]) -> str:
    """Return the message for a setting that only other `choices` of its group have."""
    group = key.partition(".")[0]
    *others, last = choices
    names = f"{', '.join(others)} or {last}" if others else last
    return f"{key} belongs to {group}={names}: give {'one of them' if others else f'{group}={last}'}"


def most_similar(wrong: str, names: Iterable[str]) -> str:
    """Return the name that was probably meant by `wrong`."""
    return max(sorted(names), key=lambda name: similarity(wrong, name))


def nearest_choice(wrong: str, choices: Sequence[str]) -> str:
    """Return a hint: the choice that was probably meant, and all choices."""
    near = most_similar(wrong, choices)
    hint = f"did you mean {near}? " if similarity(wrong, near)[0] >= NEAR_VALUE else ""
    return f"{hint}there are {', '.join(choices)}"


def similarity(wrong: str, name: str) -> tuple[float, float]:
    """Return the similarity of two names, 0 to 1, and, to break ties, of their letters in any order."""
    matcher = difflib.SequenceMatcher(None, name, wrong)
    return matcher.ratio(), matcher.quick_ratio()


def setting_names(tree: Any, prefix: str = "") -> set[str]:
    """Return the dotted names of all groups and settings in nested mappings."""
    if not isinstance(tree, dict):
        return set()
    own = {f"{prefix}{key}" for key in tree}
    return own.union(*(setting_names(value, f"{prefix}{key}.") for key, value in tree.items()))
