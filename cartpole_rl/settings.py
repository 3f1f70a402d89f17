"""The base class of all settings: frozen, strict about unknown keys, checked on construction.

A settings class lives beside the code that it configures; only `cartpole_rl.composition` knows Hydra's files.
Bounds are written on the field (``Annotated[float, Field(gt=0)]``), units in its comment.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]

CONFIDENCE = 0.95  # of every interval that is reported
NUM_SEEDS = 2**31
Seed = Annotated[int, Field(ge=0, lt=NUM_SEEDS)]


def evaluation_seed(seed: int) -> int:
    """Return the generator seed of an evaluation's carts and starts: NUM_SEEDS + `seed`.

    No training has such a seed, so no evaluation draws the carts that a training drew. It is below 2**32,
    because torch's CPU generator reads only the lowest 32 bits.
    """
    return NUM_SEEDS + seed


LARGEST = 1e30  # of a number; physics computes in float32, which ends at 3.4e38


class Settings(BaseModel):
    """A frozen pydantic model that refuses unknown keys, and truth values as numbers."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=False, validate_default=True, allow_inf_nan=False
    )

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, values: Any) -> Any:
        """Replace truth values and huge numbers by text where a number is due, so that they are refused."""
        if not isinstance(values, Mapping):
            return values
        names = {field.alias or name: name for name, field in cls.model_fields.items()}
        numeric = {each for each in values.keys() & names.keys() if _is_numeric(cls, names[each])}
        return {name: _refusable(value) if name in numeric else value for name, value in values.items()}


@cache
def _is_numeric(settings: type[Settings], name: str) -> bool:
    """Return True if a setting takes numbers, or lists or mappings of them, and nothing else."""
    classes = _classes(settings.model_fields[name].annotation)
    others = {bool, str, Any}.intersection(classes) or any(issubclass(each, Settings) for each in classes)
    return bool({int, float} & classes) and not others


def _classes(annotation: Any) -> set[Any]:
    """Return the classes in an annotation, of the values of mappings but not of their keys."""
    if get_origin(annotation) is dict:
        return _classes(get_args(annotation)[1])
    inner = [each for argument in get_args(annotation) for each in _classes(argument)]
    return {*inner, *([annotation] if annotation is Any or isinstance(annotation, type) else [])}


def _refusable(value: Any) -> Any:
    """Return nested mappings and lists with text for what is no number."""
    if isinstance(value, Mapping):
        return {name: _refusable(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_refusable(each) for each in value]
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float) and LARGEST < abs(value) < math.inf:
        return f"{str(value)[:12]}, which is over {LARGEST:g}"
    return value
