"""Checks settings that come as plain data, and says of each that is wrong what would be right."""

import difflib
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings

KINDS = re.compile(
    r"(?<=^plant\.)(simulated|emulated|serial|learned)\.|(?<=^randomization\.)(ranges|found)\."
)
NEAR = 0.8  # likeness of two names, 0 to 1, from which one may stand for the other
SAME_PLACE = 0.15  # likeness that a name gains in the same group

Config = TypeVar("Config", bound=Settings)


def checked(schema: type[Config], values: Mapping[str, Any]) -> Config:
    """`values` as `schema`. Raises ConfigError that names each key that is wrong, and what would be right."""
    try:
        return schema(**values)
    except ValidationError as error:
        complaints = (_complaint(detail, values) for detail in error.errors())
        raise ConfigError("; ".join(complaints)) from None


def _complaint(detail: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    key = KINDS.sub("", ".".join(map(str, detail["loc"])))
    if detail["type"] == "extra_forbidden":
        return no_such_setting(key, (name for name in setting_names(values) if not name.startswith(key)))
    if detail["type"] == "missing":
        return f"{key} is missing; give {key}=..."
    if detail["type"] == "union_tag_invalid":  # a choice of the group that this command does not take
        taken = detail["ctx"]["expected_tags"].replace("'", "")
        return f"{key}={detail['ctx']['tag']}: this command takes {taken}"
    reason = detail["msg"].removeprefix("Value error, ")
    if not key:
        return reason
    reason = reason[0].lower() + reason[1:]
    value = "null" if detail["input"] is None else detail["input"]
    return f"{key}={value}: {reason}" if isinstance(value, int | float | str) else f"{key}: {reason}"


def no_such_setting(key: str, known: Iterable[str]) -> str:
    """That there is no setting `key`, and the one that was meant, if one is near."""
    above, _, wrong = key.rpartition(".")

    def likeness(setting: str) -> float:
        place, _, name = setting.rpartition(".")
        return difflib.SequenceMatcher(None, wrong, name).ratio() + SAME_PLACE * (place == above)

    nearest = max(sorted(known), key=likeness, default="")
    near = bool(nearest) and likeness(nearest) > NEAR
    return f"{key}: there is no such setting; " + (
        f"did you mean {nearest}?" if near else "--cfg job shows the settings"
    )


def setting_names(tree: Any, prefix: str = "") -> set[str]:
    """Dotted names of all groups and settings in nested mappings."""
    if not isinstance(tree, dict):
        return set()
    own = {f"{prefix}{key}" for key in tree}
    return own.union(*(setting_names(value, f"{prefix}{key}.") for key, value in tree.items()))
