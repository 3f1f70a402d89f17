"""What each command reads: its settings are checked against these classes before any work is done."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.settings import ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.identification.settings import EnsembleSettings
from cartpole_rl.learning.settings import (
    BufferSettings,
    FinetuningSettings,
    LearningSettings,
    OptimizerSettings,
)
from cartpole_rl.physics.bounds import check_values
from cartpole_rl.physics.models import Actuator, CartFriction, Integrator, Models, PoleFriction
from cartpole_rl.plants.serial.settings import Rehome, SerialSettings
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.randomization.settings import IdentifiedSettings
from cartpole_rl.settings import Count, Finite, Fraction, Seed, Settings
from cartpole_rl.tasks.actions import ActionSettings

OF_SIMULATION = ("parameters", "randomization", "cart", "cart_friction", "pole_friction")


def _kind_of_randomization(given: Any) -> str:
    """A posterior of an identification, or else ranges by the parameters' names."""
    return "found" if isinstance(given, IdentifiedSettings) or "posterior" in given else "ranges"


Randomization = Annotated[
    Annotated[dict[str, Range], Tag("ranges")] | Annotated[IdentifiedSettings, Tag("found")],
    Discriminator(_kind_of_randomization),
]


class CartFrictionSettings(Settings):
    """Model of the cart's friction, and numbers that go with it in place of the cart's own."""

    model: CartFriction
    parameters: dict[str, Finite]


class PoleFrictionSettings(Settings):
    """Model of the pole's friction, and numbers that go with it in place of the cart's own."""

    model: PoleFriction
    parameters: dict[str, Finite]


class SimulatedSettings(Settings):
    """plant=simulated."""

    kind: Literal["simulated"]
    integrator: Integrator
    substeps: Annotated[int, Field(ge=1, le=200)]
    pole_presses: bool


class LearnedSettings(Settings):
    """plant=learned; a residual is learned on top of these choices of the physics, and of no others."""

    kind: Literal["learned"]
    model: Path
    prior_share: Fraction
    integrator: ClassVar = Integrator.SEMI_IMPLICIT
    substeps: ClassVar = 4
    pole_presses: ClassVar = False


class EmulatedSettings(Settings):
    """plant=emulated."""

    kind: Literal["emulated"]
    rehome: Rehome = "once"


class CartPoleSettings(Settings):
    """What a cart is and what is asked of it: the part that training and evaluation share."""

    cart: dict[str, Finite]
    cart_friction: CartFrictionSettings
    pole_friction: PoleFrictionSettings
    pole: PoleSettings
    actions: ActionSettings
    task: TaskSettings
    reward: RewardSettings
    observation: ObservationSettings
    randomization: Randomization
    control_period: Annotated[float, Field(ge=0.005, le=0.1)]

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal parameters of the cart, without the pole's."""
        return {**self.cart, **self.cart_friction.parameters, **self.pole_friction.parameters}

    @property
    def ranges(self) -> dict[str, Range]:
        """What is randomized by ranges; of carts that were found, what they leave open."""
        given = self.randomization
        return given.ranges if isinstance(given, IdentifiedSettings) else given

    def models(self, plant: SimulatedSettings | LearnedSettings) -> Models:
        """The laws that the simulated cart obeys."""
        return Models(
            self.cart_friction.model,
            self.pole_friction.model,
            Actuator(self.actions.actuator),
            plant.integrator,
            plant.pole_presses,
        )


class TrainConfig(CartPoleSettings):
    """cartpole-train."""

    plant: Annotated[SimulatedSettings | LearnedSettings, Field(discriminator="kind")]
    agent: AgentSettings
    buffer: BufferSettings
    optimizer: OptimizerSettings
    learning: LearningSettings
    seed: Seed
    label: str
    threads: Count | None
    compile: bool
    resume: str | None

    @field_validator("plant", mode="before")
    @classmethod
    def _trains_in_simulation(cls, plant: Any) -> Any:
        kind = plant.get("kind") if isinstance(plant, Mapping) else None
        if kind in ("emulated", "serial"):
            raise ValueError(
                f"training is in simulation, plant=simulated; cartpole-evaluate takes plant={kind}"
            )
        return plant

    @model_validator(mode="after")
    def _a_mirror_has_two_sides(self) -> "TrainConfig":
        motors = self.actions.motors
        if self.agent.mirrored and any(a != -b for a, b in zip(motors, reversed(motors), strict=True)):
            raise ValueError(
                f"agent.mirrored=true needs actions.motors that read backwards are their negatives, not "
                f"{list(motors)}; give agent.mirrored=false, or symmetric values"
            )
        return self

    @model_validator(mode="after")
    def _a_recurrent_network_has_frames(self) -> "TrainConfig":
        if self.agent.recurrent is not None and not self.observation.frames:
            raise ValueError(
                "agent.recurrent reads frames: it needs observation.kind=positions and more past_motors than "
                "past_positions; give observation=positions"
            )
        return self

    @model_validator(mode="after")
    def _memory_holds_a_batch(self) -> "TrainConfig":
        if self.buffer.size < self.learning.batch_size:
            raise ValueError(
                f"buffer.size {self.buffer.size} must be at least learning.batch_size "
                f"{self.learning.batch_size}"
            )
        return self


class RepeatSettings(Settings):
    """An episode of an earlier evaluation that is driven again."""

    run: Path | None = None
    episode: Annotated[int, Field(ge=0)] | None = None  # from 0, in the order of metrics.json


class EvaluateConfig(Settings):
    """cartpole-evaluate, before the agent's own config is known."""

    run: Path
    episodes: Annotated[int, Field(ge=1, le=100_000)]
    plant: Annotated[
        SimulatedSettings | LearnedSettings | EmulatedSettings | SerialSettings, Field(discriminator="kind")
    ]
    emulator: EmulatorSettings
    randomization: Randomization
    parameters: dict[str, Finite] | None
    cart: dict[str, Finite] | None = None
    cart_friction: CartFrictionSettings | None = None
    pole_friction: PoleFrictionSettings | None = None
    pole: PoleSettings | None = None
    task: dict[str, Any] | None = None  # a TaskSettings, once x_max is filled in from the agent's own
    reward: RewardSettings | None = None
    repeat: RepeatSettings = RepeatSettings()
    seed: Seed
    label: str
    threads: Count | None

    @model_validator(mode="after")
    def _the_plant_reads_it_all(self) -> "EvaluateConfig":
        """What the chosen plant would not read is refused, so that nothing is silently without effect."""
        kind = self.plant.kind
        unread = [] if kind == "simulated" else [name for name in OF_SIMULATION if getattr(self, name)]
        if kind in ("emulated", "learned") and self.pole is not None:
            unread.append("pole")
        if unread:
            remedy = "; its own are emulator.*, emulator=large" if kind == "emulated" else ""
            raise ValueError(f"{', '.join(unread)}: plant={kind} does not read it{remedy}")
        if kind != "emulated" and self.emulator != EmulatorSettings():
            raise ValueError(f"emulator: plant={kind} does not read it; give plant=emulated")
        return self


class RecordConfig(EvaluateConfig):
    """cartpole-record: what is run is said as for an evaluation."""


class FinetuneConfig(Settings):
    """cartpole-finetune."""

    run: Path | None
    plant: Annotated[EmulatedSettings | SerialSettings, Field(discriminator="kind")]
    emulator: EmulatorSettings
    episodes: Annotated[int, Field(ge=1, le=1000)]
    evaluation_episodes: Annotated[int, Field(ge=1, le=1000)]
    finetuning: FinetuningSettings
    seed: Seed
    label: str
    threads: Count | None
    compile: bool
    resume: str | None


class ReplayConfig(Settings):
    """cartpole-replay."""

    source: Annotated[Path, Field(alias="from")]
    cart: dict[str, Finite]
    cart_friction: CartFrictionSettings
    pole_friction: PoleFrictionSettings
    pole: PoleSettings | None = None
    plant: SimulatedSettings
    actuator: Actuator
    parameters: dict[str, Finite] | None
    restart: Annotated[float, Field(ge=0.1, le=60)]
    label: str


class IdentifyConfig(Settings):
    """cartpole-identify."""

    source: Annotated[Path | None, Field(alias="from")]
    plant: Annotated[EmulatedSettings | SerialSettings, Field(discriminator="kind")]
    emulator: EmulatorSettings
    cart: dict[str, Finite]
    pole: PoleSettings
    pole_friction: PoleFrictionSettings
    control_period: Annotated[float, Field(ge=0.005, le=0.1)]
    windows: Annotated[int, Field(ge=20, le=5000)]
    substeps: Annotated[int, Field(ge=1, le=200)]
    carts: Count
    seed: Seed
    label: str
    threads: Count | None

    @property
    def nominal(self) -> dict[str, float]:
        """What is thought of the cart before. Raises ConfigError."""
        if self.pole.choices is None or len(self.pole.choices) > 1:
            raise ConfigError(
                f"pole: a cart carries one pole, not {self.pole.name}; choose it, as pole=medium"
            )
        values = {**self.cart, **self.pole_friction.parameters, **self.pole.nominal.model_dump()}
        check_values(values)
        return values


class ModelConfig(Settings):
    """cartpole-model."""

    source: Annotated[tuple[Path, ...], Field(alias="from", min_length=1)]
    cart: dict[str, Finite]
    pole_friction: PoleFrictionSettings
    pole: PoleSettings | None = None
    actuator: Actuator
    windows: Annotated[int, Field(ge=10, le=10_000)]
    ensemble: EnsembleSettings
    seed: Seed
    label: str
    threads: Count | None

    @field_validator("source", mode="before")
    @classmethod
    def _one_or_several(cls, source: Any) -> Any:
        return [source] if isinstance(source, str) else source


class PreflightConfig(Settings):
    """cartpole-preflight."""

    plant: Annotated[EmulatedSettings | SerialSettings, Field(discriminator="kind")]
    emulator: EmulatorSettings


class EmulateConfig(Settings):
    """cartpole-emulate."""

    emulator: EmulatorSettings
