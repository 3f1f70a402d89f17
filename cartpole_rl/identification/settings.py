"""Settings of learning a residual."""

from typing import Annotated

from pydantic import Field

from cartpole_rl.settings import Count, NonNegative, Positive, Settings


class EnsembleSettings(Settings):
    """Settings of an ensemble and its learning."""

    members: Count
    hidden: Count  # units of each of two layers
    updates: Count
    learning_rate: Positive  # the first one; it falls along half a cosine
    refresh: Count  # updates between two searches for the windows' initial states
    validation: Annotated[float, Field(gt=0, lt=1)]  # share of the windows left out, drawn for each member
    output_penalty: NonNegative  # of outputs of 1 at random motions
    table_penalty: NonNegative  # of a force of 1 at each place, and ten times that of a step between two
