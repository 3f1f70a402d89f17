"""What can be set about learning a residual."""

from typing import Annotated

from pydantic import Field

from cartpole_rl.settings import Count, NonNegative, Positive, Settings


class EnsembleSettings(Settings):
    """How an ensemble is learned."""

    members: Count
    hidden: Count  # units of each of two layers
    updates: Count
    learning_rate: Positive  # at first; it falls along half a cosine
    refresh: Count  # updates between two searches for the windows' beginnings
    validation: Annotated[
        float, Field(gt=0, lt=1)
    ]  # of the windows, drawn for each member, by which it is stopped
    output_penalty: NonNegative  # of outputs of 1 at random motions
    table_penalty: NonNegative  # of a force of 1 at each place, and ten times that of a step between two
