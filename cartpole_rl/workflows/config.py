"""The settings of each command. A config is checked against its class before any work is done."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BeforeValidator, Field, field_validator, model_validator

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.checking import kinds, validated
from cartpole_rl.emulator.settings import ONBOARD, EmulatorSettings
from cartpole_rl.envs.settings import (
    CartFrictionSettings,
    CartPoleSettings,
    CartSettings,
    ControlPeriod,
    GuardSettings,
    ObservationSettings,
    PoleFrictionSettings,
    Randomization,
)
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.identification.settings import EnsembleSettings
from cartpole_rl.learning.settings import (
    LONGEST_RETURN,
    BufferSettings,
    DistillationSettings,
    FinetuningSettings,
    LearningSettings,
    LocalLearnerSettings,
    OptimizerSettings,
    RayLearnerSettings,
)
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.plants.settings import (
    EmulatedSettings,
    LearnedSettings,
    PlantSettings,
    PortSettings,
    SimulatedSettings,
    SimulationSettings,
    find_model,
)
from cartpole_rl.randomization.poles import PoleSettings, check_one_pole
from cartpole_rl.randomization.ranges import IdentifiedSettings
from cartpole_rl.registry import Extension
from cartpole_rl.reporting.loggers import LOGGERS
from cartpole_rl.rig.hardware import RigSettings
from cartpole_rl.rig.parameters import check_cart, check_values
from cartpole_rl.run_folder import BASELINE, is_own_policy
from cartpole_rl.settings import Count, Finite, NonNegative, Positive, Seed, Settings
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, TaskSettings

OWN_CODE = re.compile(r"[\w.]+=[\w.]+:[\w.]+: [^;]+")  # in an error: a setting that is module:name
View = Literal["none", "live", "web"]  # of the cart while it is driven: in the terminal, or on a page


class RunSettings(Settings):
    """Settings of most commands that write a run folder."""

    seed: Seed
    label: str
    threads: Count | None


def check_emulator_is_read(plant: PlantSettings, emulator: EmulatorSettings) -> None:
    """Raise ValueError for settings of an emulated cart if `plant` ignores them."""
    if not plant.reads_emulator and emulator != EmulatorSettings():
        raise ValueError(f"emulator: plant={plant.kind} does not read it; give plant=emulated")


def check_computer_drives(plant: PlantSettings, emulator: EmulatorSettings) -> None:
    """Raise ValueError for the settings of an agent on the cart's board."""
    if key := plant.policy_key(emulator):
        raise ValueError(f"{key}: only cartpole-evaluate lets the cart's board drive; leave it out")


class OnCart(Settings):
    """The cart on a port: `plant`, which is a real one or one with the settings `emulator`."""

    plant: Annotated[PortSettings, Field(discriminator="kind")]
    emulator: EmulatorSettings

    @model_validator(mode="after")
    def _this_computer_drives_what_it_reads(self) -> Self:
        check_emulator_is_read(self.plant, self.emulator)
        check_computer_drives(self.plant, self.emulator)
        return self


def _as_list(given: Any) -> Any:
    return [given] if isinstance(given, str) else given


class TrainConfig(RunSettings, CartPoleSettings):
    """The settings of cartpole-train."""

    plant: Annotated[SimulationSettings, Field(discriminator="kind")]
    agent: AgentSettings
    buffer: BufferSettings
    optimizer: OptimizerSettings
    learning: LearningSettings
    compile: bool
    device: Literal["cpu", "cuda", "auto"] = "cpu"  # missing in checkpoints of earlier versions
    logger: Annotated[tuple[Annotated[Extension, LOGGERS], ...], BeforeValidator(_as_list)] = (
        LOGGERS.find("tensorboard"),  # missing there too, or one name
    )
    preview: bool = False  # missing there too
    view: Literal["none", "web"] = "none"  # missing there too
    resume: str | None

    @model_validator(mode="before")
    @classmethod
    def _training_is_simulated(cls, values: Any) -> Any:
        plant = values.get("plant") if isinstance(values, Mapping) else None
        kind = plant.get("kind") if isinstance(plant, Mapping) else None
        if kind in kinds(OnCart, "plant"):
            taken = ", ".join(kinds(cls, "plant"))
            raise ValueError(
                f"plant={kind}: cartpole-train takes {taken}; use cartpole-evaluate for plant={kind}"
            )
        return values

    @model_validator(mode="after")
    def _agent_fits(self) -> Self:
        motors = self.actions.motors
        if self.agent.mirrored and any(a != -b for a, b in zip(motors, reversed(motors), strict=True)):
            raise ValueError(
                f"agent.mirrored=true needs actions.motors that are symmetric about 0, not {list(motors)}; "
                "give agent.mirrored=false, or symmetric values"
            )
        if self.agent.recurrent is not None and not self.observation.frames:
            raise ValueError(
                "agent.recurrent needs observation.kind=positions and more past_motors than past_positions; "
                "give observation=positions"
            )
        return self

    @model_validator(mode="after")
    def _learning_fits(self) -> Self:
        if self.resume is not None:  # the resumed run's own settings hold
            return self
        learning = self.learning.at(self.control_period)
        if learning.iterations < learning.evaluations:
            raise ValueError(
                f"learning.transitions={learning.transitions} is too few; give at least "
                f"{learning.carts * learning.chunk * learning.evaluations}, or "
                f"learning.evaluations={max(1, learning.iterations)}"
            )
        if self.buffer.size < learning.batch_size:
            raise ValueError(
                f"buffer.size {self.buffer.size} must be at least learning.batch_size {learning.batch_size}"
            )
        return self

    def check_learning(self) -> None:
        """Raise ConfigError for a new training that would learn nothing, or otherwise than its settings say.

        The settings of an earlier training may be any of these.
        """
        self.agent.check(self.control_period)
        self.buffer.check()
        self.task.check_starts()
        learning = self.learning.at(self.control_period)
        if self.buffer.size < (collected := learning.carts * learning.chunk):
            raise ConfigError(
                f"buffer.size {self.buffer.size} must be at least {collected}, the transitions that are "
                "collected at once (learning.carts times learning.chunk)"
            )
        if learning.collected_transitions <= (warmup := learning.warmup_transitions):
            chunk = learning.carts * learning.chunk
            raise ConfigError(
                f"learning.transitions={learning.transitions}: nothing would be learned, as the first "
                f"{warmup} only fill the buffer (learning.warmup_transitions); give at least "
                f"{(warmup // chunk + 1) * chunk}, or a shorter warm-up"
            )
        asked = round((learning.return_time or 0) / self.control_period)
        if self.learning.n_step is None and asked > LONGEST_RETURN:
            raise ConfigError(
                f"learning.return_time={learning.return_time:g} s is {asked} control periods; "
                f"give at most {LONGEST_RETURN * self.control_period:g}, which is {LONGEST_RETURN}"
            )

    @property
    def drawn_from(self) -> list[Path]:
        """The files that the carts come from. Raises CheckpointError."""
        model = [find_model(self.plant.model)] if isinstance(self.plant, LearnedSettings) else []
        drawn = self.randomization
        return [*model, drawn.posterior] if isinstance(drawn, IdentifiedSettings) else model


class RepeatSettings(Settings):
    """An episode of an earlier evaluation to repeat."""

    run: Path | None = None
    episode: Annotated[int, Field(ge=0)] | None = None  # from 0, in the order of metrics.json


class AnimationSettings(Settings):
    """The animations of an evaluation, in addition to that of its first episode as a GIF."""

    simulation: bool = False  # beside the first episode, the one that simulation predicts from its start
    mp4: bool = False  # each animation also as an MP4, which needs the extra `video`


class EvaluatedTask(TaskSettings):
    """The task of an evaluation. Without `x_max` it has the track of the agent's training."""

    x_max: Positive | None = None  # type: ignore[assignment]


class EvaluateConfig(RunSettings):
    """The settings of cartpole-evaluate. Groups that are None are those of the agent's training."""

    run: Path
    episodes: Annotated[int, Field(ge=1, le=100_000)]
    plant: Annotated[SimulationSettings | PortSettings, Field(discriminator="kind")]
    emulator: EmulatorSettings
    randomization: Randomization
    parameters: dict[str, Finite] | None
    cart: dict[str, Finite] | None = None
    cart_friction: CartFrictionSettings | None = None
    pole_friction: PoleFrictionSettings | None = None
    pole: PoleSettings | None = None
    task: EvaluatedTask | None = None
    reward: RewardSettings | None = None
    guard: GuardSettings | None = None
    actions: ActionSettings | None = None
    observation: ObservationSettings | None = None  # of a policy of one's own
    control_period: ControlPeriod | None = None  # of the baseline or of a policy of one's own
    knock: NonNegative = 0.0  # rad/s, see `evaluation/episodes.py`
    repeat: RepeatSettings = RepeatSettings()
    view: View = "none"
    animation: AnimationSettings = AnimationSettings()

    @model_validator(mode="after")
    def _plant_reads_every_setting(self) -> "EvaluateConfig":
        """Refuse settings that the chosen plant ignores."""
        plant, is_told = self.plant, self.run == BASELINE or is_own_policy(self.run)  # which rig it drives
        takes_cart = is_told and plant.is_on_port
        ignored = (name for name in plant.ignored if not (takes_cart and name == "cart"))
        if unread := [name for name in ignored if getattr(self, name)]:
            raise ValueError(f"{', '.join(unread)}: plant={plant.kind} {plant.why_ignored}")
        if self.view == "live" and not plant.is_on_port:
            raise ValueError(f"view=live: it shows a cart on a port; plant={plant.kind} takes view=web")
        if self.animation.simulation and not plant.is_on_port:
            raise ValueError(f"animation.simulation=true: plant={plant.kind} is simulated itself; omit it")
        check_emulator_is_read(plant, self.emulator)
        if self.observation is not None and not is_own_policy(self.run):
            raise ValueError(
                "observation: an agent observes what it did in its training; leave it out. Only a policy of "
                "your own takes it (run=module:name or run=file.onnx)"
            )
        if self.control_period is not None and not is_told:
            raise ValueError(
                "control_period: an agent drives with that of its training; leave it out. Only run=lqr and a "
                "policy of your own take it"
            )
        if self.drives_on_board and self.repeat != RepeatSettings():
            key = self.plant.policy_key(self.emulator)
            raise ValueError(f"repeat: it repeats an episode in simulation; leave out repeat.*, or {key}")
        if self.emulator.policy not in (None, ONBOARD):
            raise ValueError(
                f"emulator.policy={self.emulator.policy}: this command exports the agent of run= itself; "
                "give emulator.policy=onboard"
            )
        return self

    @model_validator(mode="after")
    def _randomization_leaves_the_parameters(self) -> "EvaluateConfig":
        """Refuse parameters that each drawn cart would have another value of."""
        drawn, given = self.randomization, self.parameters or {}
        if isinstance(drawn, IdentifiedSettings):
            if given:
                raise ValueError("parameters: randomization draws identified carts; leave one of them out")
            return self
        for name in given.keys() & drawn.keys():
            if not drawn[name].scales_nominal:
                low, high = drawn[name].limits()
                raise ValueError(
                    f"parameters.{name}: randomization.{name} draws it from {low:g} to {high:g}; leave one "
                    "of them out"
                )
        return self

    @property
    def drives_on_board(self) -> bool:
        """True if episodes are also driven by the agent on the cart's board."""
        return bool(self.plant.policy_key(self.emulator))


class RecordConfig(EvaluateConfig):
    """The settings of cartpole-record, which are those of an evaluation without figures."""

    @model_validator(mode="after")
    def _this_computer_drives_without_figures(self) -> Self:
        if self.animation != AnimationSettings():
            raise ValueError("animation: cartpole-record draws nothing; use cartpole-evaluate")
        check_computer_drives(self.plant, self.emulator)
        return self


class FinetuneConfig(RunSettings, OnCart):
    """The settings of cartpole-finetune."""

    run: Path | None
    episodes: Annotated[int, Field(ge=1, le=1000)]
    evaluation_episodes: Annotated[int, Field(ge=1, le=1000)]
    finetuning: FinetuningSettings
    learner: Annotated[LocalLearnerSettings | RayLearnerSettings, Field(discriminator="kind")] = (
        LocalLearnerSettings()
    )  # missing in runs of earlier versions
    compile: bool
    resume: str | None
    view: View = "none"


class ReplayConfig(Settings):
    """The settings of cartpole-replay. Groups that are None are those of the recorded agent."""

    source: Annotated[Path, Field(alias="from")]
    cart: dict[str, Finite] | None = None
    cart_friction: CartFrictionSettings | None = None
    pole_friction: PoleFrictionSettings | None = None
    pole: PoleSettings | None = None
    plant: SimulatedSettings
    actuator: Annotated[Law, ACTUATORS] | None = None
    parameters: dict[str, Finite] | None
    restart: Annotated[float, Field(ge=0.1, le=60)]
    view: Literal["none", "web"] = "none"
    label: str


class IdentifyConfig(RunSettings, CartSettings, OnCart):
    """The settings of cartpole-identify."""

    source: Annotated[Path | None, Field(alias="from")]
    method: Literal["matching", "one_step"] = "matching"
    pole: PoleSettings
    friction_laws: tuple[Annotated[Law, CART_FRICTIONS], ...] = ()
    control_period: ControlPeriod
    windows: Annotated[int, Field(ge=20, le=5000)]
    substeps: Annotated[int, Field(ge=1, le=200)]
    carts: Count

    @model_validator(mode="after")
    def _recordings_need_no_cart(self) -> Self:
        """Refuse settings of a cart where recordings are read."""
        unused = {"plant": EmulatedSettings(kind="emulated"), "emulator": EmulatorSettings()}
        given = ", ".join(name for name, default in unused.items() if getattr(self, name) != default)
        if self.source is not None and given:
            raise ValueError(
                f"{given}: from={self.source} reads recordings and drives no cart; leave one of them out"
            )
        return self

    @property
    def nominal(self) -> dict[str, float]:
        """The prior values of the cart's and the pole's parameters. Raises ConfigError."""
        values = self.nominal_with(check_one_pole("an identification", self.pole))
        check_values(values)
        return values


class ModelConfig(RunSettings, CartSettings):
    """The settings of cartpole-model."""

    source: Annotated[tuple[Path, ...], Field(alias="from", min_length=1), BeforeValidator(_as_list)]
    pole: PoleSettings | None = None
    actuator: Annotated[Law, ACTUATORS]
    windows: Annotated[int, Field(ge=10, le=10_000)]
    ensemble: EnsembleSettings


class ReportConfig(Settings):
    """The settings of cartpole-report."""

    runs: tuple[str, ...]
    compare: tuple[str, ...]
    measure: Annotated[str, Field(min_length=1)]
    animations: bool
    figures: bool
    format: tuple[Literal["csv", "parquet"], ...]
    label: str

    @field_validator("runs", "compare", "format", mode="before")
    @classmethod
    def _sources_are_lists(cls, sources: Any) -> Any:
        return () if sources is None else [sources] if isinstance(sources, str) else sources

    @model_validator(mode="after")
    def _has_runs(self) -> "ReportConfig":
        if not self.runs:
            raise ValueError("give runs=<run folders or patterns>")
        return self


class ExportConfig(Settings):
    """The settings of cartpole-export: an agent, with format=firmware a cart, or recordings."""

    format: Literal["weights", "onnx", "c", "web", "firmware", "minari", "mcap"]
    run: Path | None = None
    source: Annotated[Path | None, Field(alias="from")] = None
    cart: dict[str, Finite] | None = None
    pole: PoleSettings | None = None
    label: str

    @property
    def of_recordings(self) -> bool:
        """True if recordings are exported."""
        return self.format in ("minari", "mcap")

    @model_validator(mode="after")
    def _an_agent_a_cart_or_recordings(self) -> Self:
        if self.of_recordings:
            if self.run is not None or self.cart is not None or self.pole is not None:
                raise ValueError(f"format={self.format} writes recordings; leave out run, cart and pole")
            if self.source is None:
                raise ValueError(f"from: format={self.format} needs from=<run folder of cartpole-record>")
            return self
        if self.source is not None:
            raise ValueError("from: format=minari or format=mcap exports recordings; leave it out")
        if self.format == "firmware":
            if self.run is not None:
                raise ValueError("run: format=firmware writes the numbers of a cart; leave it out")
            check_cart(self.cart or {})
            if self.cart and self.cart.get("backdrivability") == 0:
                raise ValueError(
                    "cart: our firmware drives a DC motor, not a stepper; drive this cart with plant=text"
                )
        elif self.cart is not None or self.pole is not None:
            name = "pole" if self.cart is None else "cart"
            raise ValueError(
                f"{name}: format={self.format} exports an agent with its own {name}; leave it out"
            )
        elif self.run is None:
            raise ValueError("run: give run=<run folder, checkpoint file or pretrained/medium>")
        return self


class DistillConfig(RunSettings):
    """cartpole-distill."""

    run: Path
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)]
    distillation: DistillationSettings


class PreflightConfig(RigSettings, OnCart):
    """The settings of cartpole-preflight."""


Config = TypeVar("Config", bound=Settings)


def load_settings(schema: type[Config], overrides: Mapping[str, Any] | Sequence[str] = ()) -> Config:
    """Return the settings of conf/ for the command of `schema`, with overrides as on its command line.

        load_settings(TrainConfig, {"experiment": "balance", "pole": "large", "learning.carts": 512})

    By name, overrides are as in `composition.compose`. Raises ConfigError for a missing file, an unknown name
    or a value out of range.
    """
    from cartpole_rl.composition import compose  # imports Hydra

    command = re.sub(r"\B([A-Z])", r"_\1", schema.__name__.removesuffix("Config")).lower()
    return validated(schema, compose(command, overrides))


def recorded_settings(schema: type[Config], values: Mapping[str, Any], source: str) -> Config:
    """Return the settings in a checkpoint.

    Raises CheckpointError that names `source` of another version, or code of a user's own that is not found.
    """
    try:
        return validated(schema, values)
    except ConfigError as error:
        if own := OWN_CODE.match(str(error)):  # each further one says the same
            raise CheckpointError(f"{source}: {own[0]}") from None
        raise CheckpointError(f"{source} is of another version of this package: {error}") from None
