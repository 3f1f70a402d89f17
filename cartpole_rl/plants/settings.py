"""Settings of the plants: plant=simulated, learned, emulated and serial."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import INTEGRATORS
from cartpole_rl.settings import Fraction, Settings

# Homing: after connecting and after faults, and re-centring between other episodes; or before each episode.
Rehome = Literal["once", "always"]

LONGEST_WRITE = 2.0  # s; stopping a cart has to end soon, and a write can delay it for so long
Seconds = Annotated[float, Field(gt=0, le=60)]
Wait = Annotated[float, Field(gt=0, le=600)]  # s, for the cart or a person to move something


class SimulatedSettings(Settings):
    """plant=simulated."""

    kind: Literal["simulated"]
    integrator: Annotated[Law, INTEGRATORS]
    substeps: Annotated[int, Field(ge=1, le=200)]
    pole_presses: bool  # the pole's vertical force changes the cart's friction


class LearnedSettings(Settings):
    """plant=learned. The residual of a model is fitted with these physics, so they cannot be chosen."""

    kind: Literal["learned"]
    model: Path
    prior_share: Fraction
    integrator: ClassVar = INTEGRATORS.find("semi_implicit")
    substeps: ClassVar = 4
    pole_presses: ClassVar = False

    @property
    def without_prior(self) -> "LearnedSettings":
        """These settings with carts of the model alone, as an evaluation has them."""
        return self.model_copy(update={"prior_share": 0.0})


class EmulatedSettings(Settings):
    """plant=emulated."""

    kind: Literal["emulated"]
    rehome: Rehome = "once"


class SerialSettings(Settings):
    """Settings of a real cart, `plant=serial`. Times in s.

    Each timeout is an upper limit; a working cart answers sooner.
    """

    kind: Literal["serial"] = "serial"
    port: Annotated[str, Field(min_length=1)]  # /dev/ttyUSB0, COM3, a URL of pyserial, or auto: the only cart
    baud: Annotated[int, Field(ge=1, le=12_000_000)] = 921600  # 115200 is allowed too
    pole_length: Annotated[float, Field(gt=0, le=3)] | None = None  # m, twice pivot to centre of mass
    # Latched faults cleared without asking, for unattended work. A person at the terminal has to confirm the
    # others; without a terminal the command ends and says what to check.
    clear_faults: Annotated[int, Field(ge=0)] = 0
    rehome: Rehome = "once"
    # onboard: cartpole-evaluate also lets the policy on the board drive, which is the agent of run=.
    policy: Literal["onboard"] | None = None

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
    home_timeout: Wait = 120.0  # for homing
    start_timeout: Wait = 60.0  # for the pole to reach the position in which an episode starts

    @field_validator("port", mode="before")
    @classmethod
    def _port_is_a_name(cls, port: Any) -> Any:
        if isinstance(port, int):
            raise ValueError(f"give the name of a port, as /dev/ttyUSB{port} or COM{port}")
        return port
