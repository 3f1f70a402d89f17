"""Checks settings given as plain data. The message names each wrong key and the remedy."""

import difflib
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings

# the tags of unions, which pydantic adds to a key
TAGS = re.compile(
    r"(?<=^plant\.)(simulated|emulated|serial|learned)\.|(?<=^randomization\.)(ranges|identified)\."
)
NEAR = 0.8  # similarity of two names, 0 to 1, from which one is suggested for the other
SAME_GROUP = 0.15  # added to the similarity within one group

Config = TypeVar("Config", bound=Settings)


def checked(schema: type[Config], values: Mapping[str, Any]) -> Config:
    """Return `values` as a `schema`. Raises ConfigError that names each wrong key and the remedy."""
    try:
        return schema(**values)
    except ValidationError as error:
        complaints = (_complaint(detail, values) for detail in error.errors())
        raise ConfigError("; ".join(complaints)) from None


def _complaint(detail: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    key = TAGS.sub("", ".".join(map(str, detail["loc"])))
    if detail["type"] == "extra_forbidden":
        return no_such_setting(key, (name for name in setting_names(values) if not name.startswith(key)))
    if detail["type"] == "missing":
        return f"{key} is missing; give {key}=..."
    if detail["type"] == "union_tag_invalid":  # a plant that this command does not take
        taken = detail["ctx"]["expected_tags"].replace("'", "")
        return f"{key}={detail['ctx']['tag']}: this command takes {taken}"
    reason = detail["msg"].removeprefix("Value error, ")
    if not key:
        return reason
    reason = reason[0].lower() + reason[1:]
    value = "null" if detail["input"] is None else detail["input"]
    return f"{key}={value}: {reason}" if isinstance(value, int | float | str) else f"{key}: {reason}"


def no_such_setting(key: str, known: Iterable[str]) -> str:
    """Return the message for an unknown setting, with the most similar one if there is any."""
    above, _, wrong = key.rpartition(".")

    def similarity(setting: str) -> float:
        place, _, name = setting.rpartition(".")
        return difflib.SequenceMatcher(None, wrong, name).ratio() + SAME_GROUP * (place == above)

    nearest = max(sorted(known), key=similarity, default="")
    near = bool(nearest) and similarity(nearest) > NEAR
    return f"{key}: there is no such setting; " + (
        f"did you mean {nearest}?" if near else "--cfg job shows the settings"
    )


def setting_names(tree: Any, prefix: str = "") -> set[str]:
    """Return the dotted names of all groups and settings in nested mappings."""
    if not isinstance(tree, dict):
        return set()
    own = {f"{prefix}{key}" for key in tree}
    return own.union(*(setting_names(value, f"{prefix}{key}.") for key, value in tree.items()))
