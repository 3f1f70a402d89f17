"""Settings of an agent."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cartpole_rl.settings import Count, Settings


class AgentSettings(Settings):
    """The agent and its loss."""

    hidden: tuple[Count, ...]
    recurrent: Count | None  # units of a recurrent input layer that reads the last frames
    layer_norm: bool
    mirrored: bool  # the network has the mirror symmetry of left and right
    gamma: Annotated[float, Field(ge=0, lt=1)]
    double: bool  # van Hasselt et al., 2016
    action_gap: Annotated[float, Field(ge=0, lt=1)]  # alpha of advantage learning, 0 for plain Q-learning
    loss: Literal["l2", "smooth_l1"]
    target_tau: Annotated[float, Field(gt=0, le=1)] | None  # Polyak averaging each update
    target_period: Count | None  # or a copy after this many updates
    average_decay: (
        Annotated[float, Field(gt=0, lt=1)] | None
    )  # of the weights that the greedy policy acts with

    @model_validator(mode="after")
    def _one_way_to_move_the_target(self) -> "AgentSettings":
        if (self.target_tau is None) == (self.target_period is None):
            raise ValueError("give either target_tau or target_period, and null for the other")
        return self

    @model_validator(mode="after")
    def _halves_for_the_mirror(self) -> "AgentSettings":
        if self.mirrored and any(size % 2 for size in self.hidden):
            raise ValueError(f"hidden {list(self.hidden)}: a mirrored network needs even numbers of units")
        return self
