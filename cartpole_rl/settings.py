"""The base of every settings class: frozen, strict about unknown keys, checked when it is made.

A settings class lives beside the thing it sets; only `cartpole_rl.commands` fills one from Hydra.
Bounds are written on the field (``Annotated[float, Field(gt=0)]``), units in its comment.
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]

NUM_SEEDS = 2**31
Seed = Annotated[int, Field(ge=0, lt=NUM_SEEDS)]


def evaluation_seed(seed: int) -> int:
    """Return the seed of the carts and starts that an evaluation with `seed` draws: NUM_SEEDS and more.

    It is no training's seed, so that no evaluation meets the carts that a training began with. It stays
    below 2**32, since torch's generator on the CPU reads the lowest 32 bits alone.
    """
    return NUM_SEEDS + seed


class Settings(BaseModel):
    """A frozen pydantic model that refuses unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=False, validate_default=True, allow_inf_nan=False
    )
