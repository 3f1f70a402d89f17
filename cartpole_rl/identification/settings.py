"""Settings of identification: learning a residual, and layouts of logs with their import."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import RigSettings
from cartpole_rl.settings import Count, Finite, NonNegative, Positive, Settings


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


SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".dat", ".npz", ".mat", ".parquet")  # of logs in a folder
Direction = Literal["right", "left"]
Name = Annotated[str, Field(min_length=1)]


class TimeColumn(Settings):
    """The time of each row, or the time since the row before."""

    name: Name
    unit: Literal["s", "ms", "us", "ns"] = "s"
    since: Literal["start", "previous_row"] = "start"


class PositionColumn(Settings):
    """The position of the cart."""

    name: Name
    unit: Literal["m", "cm", "mm"] | Positive = "m"  # or metres in one unit of the column
    positive: Direction = "right"
    zero: Finite = 0.0  # value in the middle of the track


class AngleColumn(Settings):
    """The angle of the pole."""

    name: Name
    unit: Literal["rad", "deg", "turn"] | Positive = "rad"  # or units of the column in one turn
    positive: Direction = "right"  # the side to which the upright pole leans where the value increases
    upright: Finite = 0.0  # value of the upright pole
    wraps: bool | Positive = True  # the value jumps by a turn somewhere, or by so many units of the column


class MotorColumn(Settings):
    """The motor value."""

    name: Name
    full: Positive  # largest value in size
    positive: Direction = "right"  # the side to which a positive value pushes the cart
    row: Literal["chosen", "in_force"] = "chosen"  # chosen on the row's state, or in force before it


class Layout(Settings):
    """The layout of a log: columns, units, signs, and the rows that count."""

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None  # None: found in the file
    decimal: Literal[".", ","] = "."
    comment: Name = "#"  # at the start of a line
    time: TimeColumn
    position: PositionColumn
    angle: AngleColumn
    motor: MotorColumn
    period: Positive | None = None  # s; None: the mean between regular rows
    resample: bool = False  # where the period varies, by lines between the rows
    # column: lowest and highest value of a row that counts
    keep: dict[Name, tuple[Finite, Finite]] = Field(default_factory=dict)
    shortest: Positive = 1.5  # s of a part that is kept

    @field_validator("delimiter", mode="before")
    @classmethod
    def _tab_is_typed(cls, given: Any) -> Any:
        """Take a backslash and a t, as in a shell or in YAML's single quotes, for a tab."""
        return "\t" if given == r"\t" else given

    @model_validator(mode="after")
    def _columns_differ(self) -> "Layout":
        taken: dict[str, str] = {}
        for field in ("time", "position", "angle", "motor"):
            name = getattr(self, field).name
            if name in taken:
                raise ValueError(
                    f"{field}.name={name}: {taken[name]}.name is the same; give each its own column"
                )
            taken[name] = field
        return self

    @model_validator(mode="after")
    def _bounds_are_in_order(self) -> "Layout":
        for name, (low, high) in self.keep.items():
            if low > high:
                raise ValueError(f"keep.{name}: give the lower bound first, as [{high:g},{low:g}]")
        return self


class ImportConfig(RigSettings):
    """The settings of cartpole-import. Recordings are in the counts of `cart`."""

    source: Annotated[Path, Field(alias="from")]
    layout: Layout
    pole_length: Positive | None = None  # m, of the recorded pole
    label: str


def log_files(config: ImportConfig) -> list[Path]:
    """Return the log `from=`, or those in this folder. Raises ConfigError if there is none."""
    source = config.source
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise ConfigError(f"from={source}: there is no such file or folder")
    if not (found := logs_in(source)):
        raise ConfigError(f"from={source}: the folder holds no {', '.join(SUFFIXES)} file")
    return found


def logs_in(folder: Path) -> list[Path]:
    """Return the files of a folder that may be logs."""
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
