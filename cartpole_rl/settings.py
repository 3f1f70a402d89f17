"""The base class of all settings: frozen, strict about unknown keys, checked on construction.

A settings class lives beside the code that it configures; only `cartpole_rl.commands` fills one from Hydra.
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
    """Return the generator seed of an evaluation's carts and starts: NUM_SEEDS + `seed`.

    No training has such a seed, so no evaluation draws the carts that a training drew. It is below 2**32,
    because torch's CPU generator reads only the lowest 32 bits.
    """
    return NUM_SEEDS + seed


class Settings(BaseModel):
    """A frozen pydantic model that refuses unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=False, validate_default=True, allow_inf_nan=False
    )
