"""The description of an exported agent: its observation, motor values, guard and origin. No PyTorch."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from cartpole_rl.envs.settings import ObservationSettings, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT, POLE_COUNTS_PER_TURN
from cartpole_rl.settings import Count, Finite, Positive, Settings
from cartpole_rl.tasks.features import (
    LENGTH_SCALE,
    MOTOR_SCALE,
    THETA_DOT,
    X_DOT,
    ObservationKind,
    Quantity,
)
from cartpole_rl.tasks.settings import MotorValue, Start

FORMAT: Literal["cartpole_rl weights 1"] = "cartpole_rl weights 1"
NORM_EPSILON = 1e-5  # added to the variance; PyTorch's default


class ObservedNumber(Settings):
    """A number of the observation: `name`, as it was some control periods ago, divided by `scale`.

    It is 0 while the episode is younger than that. The motor value 1 period ago is the one sent last.
    """

    name: str  # x, x_dot, theta, theta_dot, cos_theta, sin_theta, motor or pole_length
    periods_ago: Annotated[int, Field(ge=0)]
    unit: str
    scale: Positive


class Description(Settings):
    """An agent without its weights."""

    format: Literal["cartpole_rl weights 1"] = FORMAT
    task: str
    observation: ObservationSettings
    numbers: tuple[ObservedNumber, ...]  # the observation, in order
    sizes: Annotated[
        tuple[Count, ...], Field(min_length=2)
    ]  # of the observation, each hidden layer, and the action values
    layer_norm: bool
    norm_groups: Literal[1, 2]  # parts of a hidden layer that are normalized separately
    norm_epsilon: Positive = NORM_EPSILON
    mirrored: bool  # the action values have the mirror symmetry of left and right
    motors: tuple[MotorValue, ...]  # by action index
    start: Start  # the initial angle of the pole
    angle_limit: Finite | None  # rad from upright; beyond it the episode ends. None: no limit
    guard: TrackGuard | None  # its rule is in cartpole_rl/envs/guard.py
    track_half_length: Positive  # m, of the nominal cart; a real one reports its own
    control_period: Positive  # s
    cart_metres_per_count: Positive = CART_METRES_PER_COUNT
    pole_counts_per_turn: Count = POLE_COUNTS_PER_TURN
    pole_lengths: tuple[Positive, Positive]  # m, the shortest and the longest pole of the training
    provenance: dict[str, Any]  # of the training: command, versions, commit, seed, score

    @property
    def origin(self) -> str:
        """The command of the training."""
        return " ".join(map(str, self.provenance.get("command", []))) or "unknown"

    @property
    def is_consistent(self) -> bool:
        """True if the parts that repeat each other agree, and the encoders are those of the cart."""
        ends = len(self.numbers), len(self.motors)
        scales = self.cart_metres_per_count, self.pole_counts_per_turn
        return (
            ends == (self.sizes[0], self.sizes[-1])
            and self.numbers == observed_numbers(self.observation)
            and scales == (CART_METRES_PER_COUNT, POLE_COUNTS_PER_TURN)
        )

    def shapes(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Yield the name and the shape of each array of weights."""
        last = len(self.sizes) - 2
        for number, (inputs, outputs) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            yield f"layer{number}.weight", (outputs, inputs)
            normalized = self.layer_norm and number < last
            for name in ("bias", "gain", "shift") if normalized else ("bias",):
                yield f"layer{number}.{name}", (outputs,)


def observed_numbers(observation: ObservationSettings) -> tuple[ObservedNumber, ...]:
    """Return the definition of each number of an observation, in order.

    Raises ConfigError for a `Quantity` without a name.
    """
    numbers = definitions(observation.kind.quantities, 0)
    for ago in range(1, observation.past_motors + 1):
        numbers.append(ObservedNumber(name="motor", periods_ago=ago, unit="", scale=MOTOR_SCALE))
    for ago in range(1, observation.past_velocities + 1):
        numbers += definitions((X_DOT, THETA_DOT), ago)
    for ago in range(1, observation.past_positions + 1):
        numbers += definitions(ObservationKind.POSITIONS.quantities, ago)
    if observation.pole_length:
        numbers.append(ObservedNumber(name="pole_length", periods_ago=0, unit="m", scale=LENGTH_SCALE))
    return tuple(numbers)


def definitions(quantities: Sequence[Quantity], periods_ago: int) -> list[ObservedNumber]:
    """Return the definitions of `quantities` as they were `periods_ago`."""
    if any(not quantity.name for quantity in quantities):
        raise ConfigError(
            "observation: a number of this kind has no name; name its Quantity in tasks/features.py"
        )
    return [
        ObservedNumber(name=each.name, periods_ago=periods_ago, unit=each.unit, scale=each.scale)
        for each in quantities
    ]
