"""Settings of the plants: plant=simulated, learned, emulated, serial, text and driver.

Everything that the commands ask about a plant is an attribute or a method of its settings.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, TypeAdapter, field_validator, model_validator

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import INTEGRATORS
from cartpole_rl.plants.drivers.driver import DRIVERS
from cartpole_rl.randomization.poles import Pole, PoleSettings, one_pole, pole_of_length
from cartpole_rl.registry import Extension
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware
from cartpole_rl.run_folder import check_program
from cartpole_rl.settings import Finite, Fraction, Positive, Settings
from cartpole_rl.terminal import as_word

if TYPE_CHECKING:
    from cartpole_rl.plants.emulated import CartProcess

# Homing: after connecting and after faults, and re-centring between other episodes; or before each episode.
Rehome = Literal["once", "always"]

LONGEST_WRITE = 2.0  # s; stopping a cart has to end soon, and a write can delay it for so long
Seconds = Annotated[float, Field(gt=0, le=60)]
Wait = Annotated[float, Field(gt=0, le=600)]  # s, for the cart or a person to move something


Reached = tuple["SerialSettings", "CartProcess | None"]  # the settings of a cart, and what serves its port
OF_SIMULATION = ("parameters", "randomization", "cart", "cart_friction", "pole_friction", "knock")


def changed_words(group: str, settings: Settings, defaults: Mapping[str, Any]) -> list[str]:
    """Return the words that set what differs from `defaults`."""
    return [as_word(f"{group}.{name}", value) for name, value in settings if value != defaults[name]]


class PlantSettings(Settings):
    """The settings of a plant. The methods here answer for carts that this process simulates."""

    kind: str
    place: ClassVar[str]  # "module:name" of the function that `build` calls
    is_on_port: ClassVar[bool] = False  # one cart that is driven over a port
    reads_emulator: ClassVar[bool] = False  # its cart is the one that emulator.* describes
    has_residual: ClassVar[bool] = False  # more moves its carts than the equations of physics/
    ignored: ClassVar[tuple[str, ...]] = ()  # settings of an evaluation that it does not read
    why_ignored: ClassVar[str] = "does not read it"

    @property
    def title(self) -> str:
        """The name of a cart in a heading."""
        return f"{self.kind} cart"

    @property
    def words(self) -> str:
        """The words that choose it on the command line, as a cart that this computer drives."""
        defaults = {name: field.default for name, field in type(self).model_fields.items()}
        kept = {**defaults, "kind": self.kind, "policy": getattr(self, "policy", None)}
        return " ".join([f"plant={self.kind}", *changed_words("plant", self, kept)])

    @property
    def as_evaluated(self) -> "PlantSettings":
        """These settings as an evaluation has them."""
        return self

    @property
    def has_compiled_agent(self) -> bool:
        """True if the board of a real cart drives: what was compiled for it cannot be changed."""
        return False

    def check(self) -> None:
        """Raise CartPoleError if a file that it needs is missing."""

    def is_real_time(self, emulator: EmulatorSettings) -> bool:
        """Return True for a cart with its own clock, which does not wait for this computer."""
        return False

    def policy_key(self, emulator: EmulatorSettings) -> str:
        """Return the setting that gives the cart's board a policy to drive by; empty if there is none."""
        return ""

    def known_pole_length(self, emulator: EmulatorSettings) -> float | None:
        """Return the length of the pole on the cart, m; None if the settings of the plant do not have it."""
        return None

    def own_pole(self, emulator: EmulatorSettings, trained: PoleSettings) -> PoleSettings | None:
        """Return the pole on the cart for an agent trained with `trained`; None for the pole of pole=."""
        return None

    def build(self, *arguments: Any, **named: Any) -> Any:
        """Return the plant. The function at `place` has the arguments and errors."""
        return Extension(self.kind, self.place)(self, *arguments, **named)


class SimulatedSettings(PlantSettings):
    """plant=simulated."""

    place = "cartpole_rl.plants.simulated:simulated_carts"
    kind: Literal["simulated"]
    integrator: Annotated[Law, INTEGRATORS]
    substeps: Annotated[int, Field(ge=1, le=200)]
    pole_presses: bool  # the pole's vertical force changes the cart's friction


class LearnedSettings(PlantSettings):
    """plant=learned. The residual of a model is fitted with these physics, so they cannot be chosen."""

    place = "cartpole_rl.plants.learned:learned_carts"
    has_residual = True
    ignored = (*OF_SIMULATION, "pole")
    kind: Literal["learned"]
    model: Path
    prior_share: Fraction
    integrator: ClassVar = INTEGRATORS.find("semi_implicit")
    substeps: ClassVar = 4
    pole_presses: ClassVar = False

    @property
    def as_evaluated(self) -> "LearnedSettings":
        """These settings with carts of the model alone."""
        return self.model_copy(update={"prior_share": 0.0})

    def check(self) -> None:
        """Raise CheckpointError or ConfigError if plant.model= names no learned model."""
        check_program("plant.model", self.model, "model")
        find_model(self.model)

    def own_pole(self, emulator: EmulatorSettings, trained: PoleSettings) -> PoleSettings:
        """Return the pole of the model. Raises CheckpointError."""
        found = Extension("model", "cartpole_rl.plants.learned:load_model")(self.model).parameters
        return one_pole(Pole(**{name: found[name] for name in Pole.model_fields}))


MODEL = "model.pt"  # in a run folder
REMEDY = "give a run of cartpole-model"


def find_model(source: Path) -> Path:
    """Return the path of a learned model: `source`, or the one in a run folder. Raises CheckpointError."""
    path = source / MODEL if source.is_dir() else source
    if not path.exists():
        missing = f"it holds no {MODEL}" if source.exists() else "there is no such file or folder"
        raise CheckpointError(f"plant.model={source}: {missing}; {REMEDY}")
    return path


class EmulatedSettings(PlantSettings):
    """plant=emulated."""

    place = "cartpole_rl.plants.serial.plant:cart_on_port"
    is_on_port = True
    reads_emulator = True
    can_be_damaged: ClassVar = False
    clear_faults: ClassVar = 0
    ignored = (*OF_SIMULATION, "pole")
    why_ignored = "has its own cart; set emulator.* or emulator=large"
    kind: Literal["emulated"]
    rehome: Rehome = "once"

    def is_real_time(self, emulator: EmulatorSettings) -> bool:
        """Return True if the emulated cart has the clock of a real one."""
        return emulator.clock == "real"

    def policy_key(self, emulator: EmulatorSettings) -> str:
        """Return the setting that gives the cart's board a policy to drive by; empty if there is none."""
        return "" if emulator.policy is None else f"emulator.policy={emulator.policy}"

    def known_pole_length(self, emulator: EmulatorSettings) -> float:
        """Return the length of the emulated pole, m."""
        return emulated_pole(emulator).length

    def own_pole(self, emulator: EmulatorSettings, trained: PoleSettings) -> PoleSettings:
        """Return the emulated pole."""
        return one_pole(emulated_pole(emulator))

    @contextmanager
    def reachable(self, emulator: EmulatorSettings, hardware: Hardware) -> "Iterator[Reached]":
        """Start a hanging cart, and yield how to reach it. Raises EmulatorError, ConfigError."""
        from cartpole_rl.plants.emulated import EmulatedCart  # which imports this module

        if emulator.start != "hanging":
            raise ConfigError(f"emulator.start={emulator.start}: this cart starts hanging; leave it out")
        with EmulatedCart(emulator) as cart:
            yield cart.settings, cart


def emulated_pole(emulator: EmulatorSettings) -> Pole:
    """Return the pole of an emulated cart."""
    return Pole(**emulator.model_dump(include=set(Pole.model_fields)))


class RealCartSettings(PlantSettings):
    """A cart at a port of this computer. Times in s.

    Each timeout is an upper limit; a working cart answers sooner.
    """

    place = "cartpole_rl.plants.serial.plant:cart_on_port"
    is_on_port = True
    can_be_damaged: ClassVar = True
    ignored: ClassVar[tuple[str, ...]] = OF_SIMULATION
    port: Annotated[str, Field(min_length=1)]  # /dev/ttyUSB0, COM3, a URL of pyserial, or auto: the only cart
    baud: Annotated[int, Field(ge=1, le=12_000_000)] = 921600  # 115200 is allowed too
    pole_length: Annotated[float, Field(gt=0, le=3)] | None = None  # m, twice pivot to centre of mass
    # Latched faults cleared without asking, for unattended work. A person at the terminal has to confirm the
    # others; without a terminal the command ends and says what to check.
    clear_faults: Annotated[int, Field(ge=0)] = 0
    rehome: Rehome = "once"

    # Without a state for so long, the link is lost. So it is when this computer does not answer a state for
    # so long, or for 1 s if the timeout is larger.
    timeout: Seconds = 1.0
    connect_timeout: Seconds = 3.0  # for the first answer; a board that restarts when opened needs about 1 s
    answer_timeout: Seconds = 0.5  # for ACK, NACK or INFO; then the question is repeated
    retries: Annotated[int, Field(ge=0, le=100)] = 3  # repetitions of a question without an answer
    # For the operating system to take the bytes of a frame; a motor value is refused after three periods.
    write_timeout: Annotated[float, Field(gt=0, le=LONGEST_WRITE)] = 0.2
    # Silence after which the host sends HELLO. It is longer than any period: a HELLO delays the next state.
    nudge_after: Annotated[float, Field(ge=0.2, le=60)] = 0.5
    home_timeout: Wait = 120.0  # for homing; about 20 s for each metre of track, and a minute
    start_timeout: Wait = 60.0  # for the pole to reach the position in which an episode starts

    @field_validator("port", mode="before")
    @classmethod
    def _port_is_a_name(cls, port: Any) -> Any:
        if isinstance(port, int):
            raise ValueError(f"give the name of a port, as /dev/ttyUSB{port} or COM{port}")
        return port

    @property
    def title(self) -> str:
        """The name of the cart in a heading."""
        return f"cart on {self.port}"

    def is_real_time(self, emulator: EmulatorSettings) -> bool:
        """Return True: a real cart does not wait for this computer."""
        return True

    def known_pole_length(self, emulator: EmulatorSettings) -> float | None:
        """Return the stated length of the pole, m; None if it is not stated."""
        return self.pole_length

    def own_pole(self, emulator: EmulatorSettings, trained: PoleSettings) -> PoleSettings | None:
        """Return a pole of the stated length; None if it is not stated."""
        return pole_of_length(self.pole_length, trained) if self.pole_length else None


class SerialSettings(RealCartSettings):
    """Settings of a real cart with our firmware, `plant=serial`."""

    kind: Literal["serial"] = "serial"
    # onboard: cartpole-evaluate also lets the policy on the board drive, which is the agent of run=.
    policy: Literal["onboard"] | None = None

    @property
    def has_compiled_agent(self) -> bool:
        """True if the board drives: what was compiled for it cannot be changed."""
        return self.policy is not None

    def policy_key(self, emulator: EmulatorSettings) -> str:
        """Return the setting that lets the policy on the board drive; empty if it does not."""
        return "" if self.policy is None else f"plant.policy={self.policy}"

    @contextmanager
    def reachable(self, emulator: EmulatorSettings, hardware: Hardware) -> "Iterator[Reached]":
        """Yield these settings."""
        yield self, None


class BoardSettings(RealCartSettings):
    """A cart with firmware of its own, for which this computer stands in for ours (docs/my-cart.md)."""

    ignored = tuple(name for name in OF_SIMULATION if name != "cart")  # a board does not tell its rig
    driver: Annotated[Extension, DRIVERS]
    # hand: a person puts the cart in the middle; board: its own homing; stops: this computer finds the stops.
    homing: Literal["hand", "board", "stops"] = "hand"
    home_position: Finite = 0.0  # m right of the middle, where the board's own homing leaves the cart
    # What the board takes: a motor value (PWM, V, ...), the cart's speed (m/s), or its acceleration (m/s^2).
    sends: Literal["value", "speed", "acceleration"] = "value"
    full: Finite  # what is sent at motor value 255 (speed: the acceleration, m/s^2); negative: reversed motor
    damping: Annotated[float, Field(ge=0, le=20)] = 0.0  # 1/s: slows a cart that its board does not slow down
    fastest: Positive = 1.0  # m/s, the largest speed that is sent
    cart_reversed: bool = False  # the cart's counts grow to the left
    pole_reversed: bool = False  # the pole's counts grow to the left
    # The counts between which a potentiometer at the pole is right; the rest of the turn is its dead zone.
    pole_range: tuple[int, int] | None = None
    watchdog: bool = False  # the board stops its motor by itself when no command comes

    @model_validator(mode="after")
    def _full_moves_the_cart(self) -> Self:
        if not self.full:
            raise ValueError("full is 0: give what the board takes at motor value 255")
        fastest = self.fastest != BoardSettings.model_fields["fastest"].default
        if self.sends == "value" and (self.damping or fastest):
            name = "damping" if self.damping else "fastest"
            raise ValueError(f"{name} is for sends=speed and sends=acceleration; leave it out")
        if self.pole_range is not None and not self.pole_range[0] < self.pole_range[1]:
            raise ValueError(f"pole_range={list(self.pole_range)}: give the smaller count first")
        if self.homing != "board" and self.home_position:
            raise ValueError(f"home_position is for homing=board, not homing={self.homing}; leave it out")
        if self.homing == "stops" and self.sends != "value":
            raise ValueError(
                f"homing=stops with sends={self.sends}: a stepper loses steps at a stop; give hand or board"
            )
        return self

    @property
    def lacks(self) -> list[str]:
        """The protections that this cart lacks, a line each."""
        every = "this computer stands in for the limits, the brake and the watchdog, once a measurement"
        alone = "if this computer or the cable fails, nothing stops a moving cart: keep a switch at hand"
        homes = "if the cart does not move now, its board has not homed: press Ctrl-C"
        told = [] if self.watchdog else [alone]
        return [every, *told, *([homes] if self.homing == "board" else [])]

    def over(self, port: str) -> SerialSettings:
        """Return the settings of the cart that a bridge on `port` stands for."""
        shared = set(RealCartSettings.model_fields) - {"kind", "port", "baud"}
        return SerialSettings(**self.model_dump(include=shared), port=port)

    @contextmanager
    def reachable(self, emulator: EmulatorSettings, hardware: Hardware) -> "Iterator[Reached]":
        """Start a bridge, and yield how to reach it. Raises LinkError, PortError, ConfigError."""
        from cartpole_rl.plants.emulated import BridgeProcess  # which imports this module

        with BridgeProcess(self, hardware, None) as bridge:
            yield self.over(bridge.port), bridge


EXPONENT = re.compile(r"\de-\d", re.IGNORECASE)
Column = Literal["time", "cart", "pole", "-"]


def is_line(text: str) -> bool:
    """Return True if `text` can be sent as a line."""
    return bool(text) and text.isascii() and text.isprintable()


class TextSettings(BoardSettings):
    """plant=text: a board that sends and takes lines of text."""

    kind: Literal["text"]
    driver: Annotated[Extension, DRIVERS] = DRIVERS.find("text")
    baud: Annotated[int, Field(ge=1, le=12_000_000)] = 115200
    columns: tuple[Column, ...] = ("time", "cart", "pole")  # of a line of the board; - is not read
    separator: Annotated[str, Field(min_length=1)] = ","
    time_unit: Literal["us", "ms", "s"] = "us"
    cart_unit: Literal["counts", "mm", "m"] = "counts"
    pole_unit: Literal["counts", "deg", "rad"] = "counts"
    line: str = "{:.0f}"  # of this computer, with the command in place of {}: a={:.3f}
    stop_line: str | None = None  # otherwise the command 0
    home_line: str | None = None  # starts the board's own homing

    @field_validator("columns")
    @classmethod
    def _cart_and_pole_are_read(cls, columns: tuple[Column, ...]) -> tuple[Column, ...]:
        for name in ("cart", "pole"):
            if columns.count(name) != 1:
                raise ValueError(f"name the column {name} once, as in [time, cart, pole]")
        if columns.count("time") > 1:
            raise ValueError("name the column time once at most")
        return columns

    @field_validator("line")
    @classmethod
    def _line_takes_a_number(cls, line: str) -> str:
        try:
            written = line.format(-1.5), line.format(1.5)
        except (ValueError, LookupError, AttributeError, TypeError) as error:
            raise ValueError(f"{error}; write it with one number, as in a={{:.3f}}") from None
        if written[0] == written[1] or not is_line(written[0]):
            raise ValueError("it must be one line with the command in place of {}, as in a={:.3f}")
        if EXPONENT.search(line.format(1.5e-5)):
            raise ValueError(
                "it writes small commands as 1.5e-05, which boards misread: give decimals, as in {:.3f}"
            )
        return line

    @field_validator("stop_line", "home_line")
    @classmethod
    def _other_lines_are_lines(cls, line: str | None) -> str | None:
        if line is not None and not is_line(line):
            raise ValueError(f"{line!r} is not one line of text")
        return line

    @model_validator(mode="after")
    def _lines_and_columns_fit(self) -> Self:
        least = abs(self.full) / LARGEST_MOTOR
        if self.line.format(least) in (self.line.format(0.0), self.line.format(-0.0)):
            raise ValueError(
                f"line={self.line} writes {least:.3g}, which is motor value 1, as 0: give more decimals"
            )
        if self.homing == "board" and self.home_line is None:
            raise ValueError("homing=board needs home_line, the line that starts the board's own homing")
        if self.homing != "board" and self.home_line is not None:
            raise ValueError("home_line is for homing=board: give homing=board, or leave it out")
        if "time" not in self.columns and self.time_unit != "us":
            raise ValueError("time_unit is of the column time, which columns does not name; leave it out")
        return self

    @property
    def lacks(self) -> list[str]:
        """The protections that this cart lacks, a line each."""
        lines = "a damaged line that still reads as numbers is only noticed if they jump"
        clock = (
            "without a column time, old lines are taken for new ones, and a restart is seen only by a jump"
        )
        return [*super().lacks, lines, *([] if "time" in self.columns else [clock])]


class DriverSettings(BoardSettings):
    """plant=driver: a class of one's own that reads and commands a board."""

    kind: Literal["driver"]
    options: Annotated[dict[str, Any], Field(default_factory=dict)]  # for the class


BOARDS: TypeAdapter[BoardSettings] = TypeAdapter(
    Annotated[TextSettings | DriverSettings, Field(discriminator="kind")]
)
SimulationSettings = SimulatedSettings | LearnedSettings
PortSettings = EmulatedSettings | SerialSettings | TextSettings | DriverSettings
