"""Settings of learning, and the schedules in them: functions of progress, so nothing of them is resumed."""

import math
import re
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Count, Fraction, NonNegative, Positive, Settings


def linear(start: float, end: float, progress: float) -> float:
    """Return a value that goes from `start` at progress 0 to `end` at 1, and stays there."""
    return start + (end - start) * min(max(progress, 0.0), 1.0)


def half_cosine(start: float, end: float, progress: float) -> float:
    """Return a value that goes from `start` at progress 0 to `end` at 1 along half a cosine."""
    return linear(end, start, 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0))))


class BufferSettings(Settings):
    """Replay buffer; `alpha` and `beta` as in Schaul et al., "Prioritized experience replay", 2016."""

    kind: Literal["prioritized", "uniform"]
    size: Annotated[int, Field(ge=1, le=10**9)]  # transitions
    alpha: Annotated[float, Field(ge=0, le=2)]  # TorchRL's priority is the squared error, so it acts doubled
    beta: tuple[Fraction, Fraction]  # from the first to the last update, linearly
    priority_eps: Positive

    def check(self) -> None:
        """Raise ConfigError for priorities that a new training would not use."""
        if self.kind == "prioritized" and self.alpha == 0:
            raise ConfigError(
                "buffer.alpha=0: with it, buffer.kind=prioritized draws uniformly; give buffer=prioritized, "
                "or buffer=uniform"
            )


class OptimizerSettings(Settings):
    """Adam or AdamW."""

    kind: Literal["adam", "adamw"]
    learning_rate: Positive
    learning_rate_end: Fraction  # share of `learning_rate` at the end, reached along half a cosine
    weight_decay: NonNegative
    max_grad_norm: Positive

    def rate(self, progress: float) -> float:
        """Return the learning rate after a share of the training."""
        return half_cosine(self.learning_rate, self.learning_rate * self.learning_rate_end, progress)


LONGEST_RETURN = 20  # control periods


class LearningSettings(Settings):
    """The training loop: an iteration collects `chunk` periods on each cart, then makes `updates` updates."""

    transitions: Count  # transitions in all
    carts: Count  # simulated in parallel
    chunk: Count  # periods
    retry_probability: Fraction  # that a cart is kept for another episode after a failed one
    updates: Count  # gradient steps per iteration
    batch_size: Count
    return_time: Positive | None = None  # s, the longest return
    n_step: Annotated[int, Field(ge=1, le=LONGEST_RETURN)] | None = None  # or its length in control periods
    # The first episodes end one after the other, not all at once. None: if the buffer holds few episodes
    staggered: bool | None = False  # missing in checkpoints of earlier versions
    carry: bool  # the last n_step - 1 periods of a chunk wait for the next one, for whole returns
    warmup_transitions: Annotated[int, Field(ge=0)]  # random actions before the first update
    epsilon: tuple[Fraction, Fraction]  # exploration, from first to last
    epsilon_transitions: Count  # over which epsilon falls, linearly
    evaluations: Count  # during training, evenly spaced, the last at the end
    evaluation_episodes: Count
    checkpoint_interval: Count  # evaluations from one resumable checkpoint to the next

    @model_validator(mode="after")
    def _returns_have_a_length(self) -> "LearningSettings":
        if self.n_step is None and self.return_time is None:
            raise ValueError("give return_time (s), or n_step (control periods)")
        if self.n_step is not None and self.chunk < self.n_step:
            raise ValueError(f"chunk {self.chunk} must be at least n_step {self.n_step}")
        return self

    def at(self, control_period: float) -> Self:
        """Return the settings with `n_step`, for a control period in s.

        A chunk that is shorter than a return is lengthened, with as many updates more.
        """
        if self.n_step is not None:
            return self
        assert self.return_time is not None
        n_step = min(max(1, round(self.return_time / control_period)), LONGEST_RETURN)
        chunk = max(self.chunk, n_step)
        updates = round(self.updates * chunk / self.chunk)
        return self.model_copy(update={"n_step": n_step, "chunk": chunk, "updates": updates})

    @property
    def steps(self) -> int:
        """The longest return in control periods; `at` sets it where only seconds are given."""
        assert self.n_step is not None
        return self.n_step

    @property
    def iterations(self) -> int:
        """Rounds of collecting and learning."""
        return self.transitions // (self.carts * self.chunk)

    @property
    def collected_transitions(self) -> int:
        """Transitions in whole iterations: `transitions` or slightly fewer."""
        return self.iterations * self.carts * self.chunk

    @property
    def evaluated_iterations(self) -> list[int]:
        """The iterations that end with an evaluation: evenly spaced, the last one too."""
        return [round(self.iterations * (place + 1) / self.evaluations) for place in range(self.evaluations)]

    @property
    def saved_iterations(self) -> list[int]:
        """The iterations that end with a checkpoint to resume from; the last one is one of them."""
        return self.evaluated_iterations[:: -self.checkpoint_interval]

    def exploration(self, transitions: int) -> float:
        """Return the share of random actions after so many transitions."""
        if transitions < self.warmup_transitions:
            return 1.0
        return linear(*self.epsilon, (transitions - self.warmup_transitions) / self.epsilon_transitions)


class DistillationSettings(Settings):
    """Distillation of an agent into a smaller network."""

    carts: Count  # simulated in parallel
    rounds: Count  # of driving, then learning
    periods: Count  # that each cart is driven in a round
    updates: Count  # gradient steps in a round
    batch_size: Count
    learning_rate: Positive  # at the start; it falls along half a cosine
    epsilon: Fraction  # share of random actions
    value_weight: NonNegative  # of the error of the mean action value; the error of the advantages has 1


def host_and_port(text: str) -> str:
    """Return `text` if it is host:port. Raises ValueError."""
    found = re.fullmatch(r"[^/\s:]+:([0-9]{1,5})", text)
    if not found or not 0 < int(found[1]) < 65536:
        raise ValueError("give host:port, with a port from 1 to 65535")
    return text


class LocalLearnerSettings(Settings):
    """learner=local: the learner of a fine-tuning is a process on the computer of the cart."""

    kind: Literal["local"] = "local"


class RayLearnerSettings(Settings):
    """learner=ray: the learner of a fine-tuning is on another machine, in a Ray cluster."""

    kind: Literal["ray"]
    address: Annotated[str, AfterValidator(host_and_port)]  # of the Ray head
    episodes_ahead: Annotated[int, Field(ge=0)]  # driven with earlier weights while the learner is lost
    timeout: Annotated[float, Field(gt=0, le=600)]  # s without an answer: the learner counts as lost


class FinetuningSettings(Settings):
    """Fine-tuning of a trained agent on one cart."""

    iterations: Count  # of learning while one episode is driven
    refit: Count  # episodes between two fits of the simulator
    cart_share: Fraction  # of each batch that the cart recorded; the rest is simulated
    prior_share: Fraction  # of the simulated carts that are drawn as in training, not from the fit
    widen: Positive  # factor on the fit's standard deviations
    epsilon: Annotated[float, Field(ge=0, le=0.2)]  # share of random actions on the cart
    simulated_epsilon: tuple[Fraction, Fraction]  # share of random actions in simulation, first to last
    simulated_epsilon_share: Annotated[float, Field(gt=0, le=1)]  # of these transitions, over which it falls
    warmup_transitions: Annotated[int, Field(ge=0)]  # random actions in simulation before the first update
    buffer_kind: Literal["prioritized", "uniform"]  # of the simulated transitions
    learning_rate: Positive  # at the start; it falls along half a cosine

    @model_validator(mode="after")
    def _recorded_transitions_have_no_priority(self) -> "FinetuningSettings":
        if self.buffer_kind == "prioritized" and self.cart_share > 0:
            raise ValueError(
                "finetuning.buffer_kind=prioritized: recorded transitions have no priority; give "
                "finetuning.buffer_kind=uniform, or finetuning.cart_share=0"
            )
        return self
