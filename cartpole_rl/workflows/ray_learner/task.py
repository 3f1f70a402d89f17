"""What the machine of the cart sends to a learner, and what the learner reports."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cartpole_rl.learning.checkpoints import AgentCheckpoint
from cartpole_rl.learning.dqn import Scalars


@dataclass(frozen=True)
class LearnerTask:
    """All that a learner needs to start, or to continue after `learned` episodes; settings as plain data."""

    name: str  # of the run; the same after a resumption
    folder: Path  # absolute, on the machine of the cart
    config: Mapping[str, Any]  # of the fine-tuning
    evaluation: Mapping[str, Any]  # of the driving
    start: AgentCheckpoint
    learned: int
    weights: bytes  # packed, after `learned` episodes

    @property
    def cart(self) -> str:
        """The Ray resource of the cart's node."""
        return f"cart_{self.name}"


@dataclass
class Report:
    """The progress of the learner with the name `learner`, from entry `first` of each list on."""

    learner: str
    first: tuple[int, int] = (0, 0)  # of the curves and of the messages
    curves: list[tuple[int, Scalars]] = field(default_factory=list)  # each after that many episodes
    messages: list[str] = field(default_factory=list)
    failure: str | None = None  # the error that ended learning

    @property
    def next(self) -> tuple[int, int]:
        """The numbers of curves and messages so far."""
        return self.first[0] + len(self.curves), self.first[1] + len(self.messages)
