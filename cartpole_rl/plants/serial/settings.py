"""Settings of a cart on a serial port."""

from typing import Annotated, Literal

from pydantic import Field

from cartpole_rl.settings import Count, Positive, Settings

# Homing: after connecting and after faults, and re-centring between other episodes; or before each episode.
Rehome = Literal["once", "always"]


class SerialSettings(Settings):
    """Settings of a real cart, `plant=serial`. Times in s.

    Each timeout is the longest wait; a cart that works is never waited for so long.
    """

    kind: Literal["serial"] = "serial"
    port: Annotated[str, Field(min_length=1)]  # /dev/ttyUSB0, COM3, a URL of pyserial, or auto: the only cart
    baud: Count = 921600  # 115200 is allowed too
    pole_length: Annotated[float, Field(gt=0, le=3)] | None = None  # m, twice pivot to centre of mass
    # Latched faults cleared without asking, for unattended work. A person at the terminal has to confirm the
    # others; without a terminal the command ends and says what to check.
    clear_faults: Annotated[int, Field(ge=0)] = 0
    rehome: Rehome = "once"

    timeout: Positive = 1.0  # without a state for so long, the link is lost
    connect_timeout: Positive = 3.0  # for the first answer; a board that restarts when opened needs about 1 s
    answer_timeout: Positive = 0.5  # for ACK, NACK or INFO; then the question is repeated
    retries: Annotated[int, Field(ge=0)] = 3  # repetitions of a question without an answer
    write_timeout: Positive = 1.0  # for the operating system to take the bytes of a frame
    nudge_after: Positive = 0.5  # silence after which the host sends HELLO
    home_timeout: Positive = 120.0  # for homing
    start_timeout: Positive = 60.0  # for the pole to reach the position in which an episode starts
