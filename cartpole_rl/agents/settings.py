"""Settings of an agent, and the kinds of agents and networks to choose from."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.settings import Count, Positive, Settings


class AgentKind(Extension):
    """A kind of agent: a class such as `learning.agent.QAgent`, which is made with the same arguments.

    Its instances are modules with `greedy_policy()`, from `observation` to `action` and `action_value`.
    `learner` is a class, or its place, that trains one: such as `learning.dqn.Training`.
    """

    def __init__(self, name: str, item: Any, learner: Any = "cartpole_rl.learning.dqn:Training") -> None:
        super().__init__(name, item)
        self.learner = Extension(f"the learner of {name}", learner)


def _check_agent(item: Any) -> None:
    if not callable(getattr(item, "greedy_policy", None)):
        raise ValueError("it has no `greedy_policy`")


AGENTS = Registry("agent", __name__, AgentKind, _check_agent)
AGENTS.add("dqn", "cartpole_rl.learning.agent:QAgent")
NETWORKS: Registry[Extension] = Registry("network", __name__)  # functions as `agents.network.q_network`
NETWORKS.add("mlp", "cartpole_rl.agents.network:q_network")


# Control periods: a discount in float32, or an action gap of four digits, is then below 1
LONGEST_HORIZON, LONGEST_ACTION = 1_000_000, 10_000


class AgentSettings(Settings):
    """The agent and its loss."""

    kind: Annotated[AgentKind, AGENTS] = AGENTS.find("dqn")  # missing in checkpoints of earlier versions
    network: Annotated[Extension, NETWORKS] = NETWORKS.find("mlp")
    hidden: tuple[Count, ...]
    recurrent: Count | None  # units of a recurrent input layer that reads the last frames
    layer_norm: bool
    mirrored: bool  # the network has the mirror symmetry of left and right
    horizon: Positive | None = None  # s over which rewards count: discounted by exp(-t / horizon)
    gamma: Annotated[float, Field(ge=0, lt=1)] | None = None  # or the discount of a control period
    double: bool  # van Hasselt et al., 2016
    action_time: Positive | None = None  # s for which an action seems to last, by the action gap
    action_gap: Annotated[float, Field(ge=0, lt=1)] | None = None  # or alpha of advantage learning; 0: none
    loss: Literal["l2", "smooth_l1"]
    target_tau: Annotated[float, Field(gt=0, le=1)] | None  # Polyak averaging each update
    target_period: Count | None  # or a copy after this many updates
    average_decay: Annotated[float, Field(gt=0, lt=1)] | None  # of the weights of the greedy policy

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.target_tau is None) == (self.target_period is None):
            raise ValueError("give either target_tau or target_period, and null for the other")
        if self.horizon is None and self.gamma is None:
            raise ValueError("give horizon (s), or gamma (of a control period)")
        if self.action_time is None and self.action_gap is None:
            raise ValueError("give action_time (s), or action_gap (of a control period)")
        if self.mirrored and any(size % 2 for size in self.hidden):
            raise ValueError(f"hidden {list(self.hidden)}: a mirrored network needs even numbers of units")
        fewest = 4 if self.mirrored else 2
        if self.layer_norm and any(size < fewest for size in self.hidden):
            raise ValueError(
                f"hidden {list(self.hidden)}: layer_norm makes a single unit constant"
                f"{', and mirrored halves the units' if self.mirrored else ''}; give at least {fewest}"
            )
        return self

    @property
    def discount(self) -> float:
        """The discount of a control period; `at` sets it where only seconds are given."""
        assert self.gamma is not None
        return self.gamma

    @property
    def gap(self) -> float:
        """The action gap of a control period, likewise."""
        assert self.action_gap is not None
        return self.action_gap

    def at(self, control_period: float) -> Self:
        """Return the settings with `gamma` and `action_gap`, for a control period in s.

        The action gap widens the lead of the best action 1 / (1 - action_gap) times, as if an action lasted
        `action_time`. Both are 0 for a control period that is longer than their time.
        """
        gamma, gap = self.gamma, self.action_gap
        if gamma is None and self.horizon is not None:
            gamma = max(0.0, 1 - control_period / self.horizon)
        if gap is None and self.action_time is not None:
            gap = max(0.0, round(1 - control_period / self.action_time, 4))
        return self.model_copy(update={"gamma": gamma, "action_gap": gap})

    def check(self, control_period: float) -> None:
        """Raise ConfigError for a new training with a discount or an action gap of nearly 1."""
        for given, name, time, longest, number in (
            (self.gamma, "horizon", self.horizon, LONGEST_HORIZON, "discount"),
            (self.action_gap, "action_time", self.action_time, LONGEST_ACTION, "action gap"),
        ):
            most = longest * control_period
            if given is None and time is not None and time > most * (1 + 1e-9):  # a rounded product
                raise ConfigError(
                    f"agent.{name}={time:g}: its {number} would be all but 1; give at most {most:g} s"
                )
