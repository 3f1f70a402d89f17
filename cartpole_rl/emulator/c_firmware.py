"""The C firmware, ``firmware/src/``, with the methods of `Firmware`: either can run an emulated cart.

It is built for a rig as a shared library with the machine's own C compiler, on first use.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

from cartpole_rl.emulator.firmware import MOST_PENDING
from cartpole_rl.emulator.guards import LEVER, micrometres
from cartpole_rl.errors import EmulatorError
from cartpole_rl.rig.hardware import Hardware, nominal_hardware
from cartpole_rl.wire.frames import END, open_envelope
from cartpole_rl.wire.messages import MESSAGES, Fault, Message, SetMotor

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-ffp-contract=off", f"-DCART_PENDING={MOST_PENDING}"]
RIG = {  # macros of cart_rig.h: attributes of Hardware, those in m as um, and comments
    "CART_NANOMETRES": ("cart_nanometres_per_count", "nm per count of the cart's encoder"),
    "CART_POLE_COUNTS": ("pole_counts_per_turn", "counts per turn of the pole's encoder"),
    "CART_SPAN_UM": ("track_span", "um between the stops, nominal"),
    "CART_SOFT_LIMIT_UM": ("soft_limit", "um inside a stop: from there on outward motor values give 0"),
    "CART_HARD_LIMIT_UM": ("hard_limit", "um inside a stop: an armed cart there is faulted"),
    "CART_BRAKING_UM_S2": ("braking", "um/s^2: full motor inward slows any healthy cart at least so hard"),
    "CART_HARD_PUSH": ("hard_push", "smallest motor value that moves any healthy cart"),
    "CART_MOVING_MASS": ("moving_mass", "kg: cart and pole, roughly, as all numbers below"),
    "CART_MOVING_FRICTION": ("moving_friction", "N"),
    "CART_MOTOR_OFFSET": ("motor_offset", "motor value at which the force starts"),
    "CART_MOTOR_PER_NEWTON": ("motor_per_newton", "motor values per N beyond it"),
    "CART_GENTLE_FORCE": ("gentle_force", "N, the largest of homing"),
    "CART_SWITCHES": ("switches", "end switches: 0 none, 1 left, 2 right, 3 both"),
    "CART_POLE_LEVER_UM": ("", "um: m_p l / (m_c + m_p) of the pole, for the brake"),
}
LONGEST_ANSWER = 70  # bytes: 2 * CART_FRAME_BYTES
SNAPSHOT_NUMBERS = 99


class CartHead(ctypes.Structure):
    """The first fields of a `cart` in ``firmware/src/cart.h``."""

    _fields_ = (
        ("policy", ctypes.c_void_p),
        ("policy_memory", ctypes.c_void_p),
        ("policy_identity", ctypes.c_uint32),
        ("pole_trim", ctypes.c_int32),
        ("pole_lever_um", ctypes.c_int32),
        ("period_us", ctypes.c_uint32),
        ("armed", ctypes.c_bool),
        ("homed", ctypes.c_bool),
        ("homing", ctypes.c_bool),
        ("fault", ctypes.c_uint16),
        ("carried_out", ctypes.c_uint8),
        ("switches", ctypes.c_uint8),
    )


def of_head(name: str, is_set: bool = False) -> Any:
    """Return a property that is a field of the cart's head; with `is_set` it can be set, too."""

    def put(cart: "CFirmware", value: Any) -> None:
        setattr(cart._head, name, value)

    return property(attrgetter(f"_head.{name}"), put if is_set else None)


class CFirmware:
    """The C firmware of one cart, just booted: idle, not homed, motor 0. Times are us since boot."""

    period_us: int = of_head("period_us")  # of the next period
    armed: bool = of_head("armed")  # the cart obeys SET_MOTOR
    homed: bool = of_head("homed", is_set=True)  # the zeros are set
    homing: bool = of_head("homing")
    # end switches that are pressed: 1 left, 2 right; set it before each `look`
    switches: int = of_head("switches", is_set=True)

    def __init__(
        self,
        delay_us: Callable[[], int],
        zero_error: int = 0,
        lever_um: int = LEVER,
        policy: Path | None = None,
        pole_length: float = 0.0,
        hardware: Hardware | None = None,
    ) -> None:
        """`delay_us` returns a command's latency; homing sets the pole's zero `zero_error` counts too low.

        `lever_um` is that of `TrackLimits`; `hardware` is ip02's if it is None.
        `policy` is a folder with policy.h and policy.c, of an agent that drives on the board; it may observe
        `pole_length` in m. Raises EmulatorError if the C firmware cannot be compiled.
        """
        self._library = load_library(policy, hardware)
        self._memory = ctypes.create_string_buffer(self._library.cart_size())
        self._policy_memory = ctypes.create_string_buffer(max(1, self._library.cart_policy_size()))
        self._head = CartHead.from_buffer(self._memory)
        self._answer = ctypes.create_string_buffer(LONGEST_ANSWER)
        self._library.cart_boot(self._memory)
        self._library.cart_attach_policy(self._memory, self._policy_memory, pole_length)
        self._head.pole_trim, self._head.pole_lever_um = zero_error, lever_um
        self._delay_us = delay_us
        self.carried_out: Message | None = None  # the newest message; None if it was refused or damaged

    @property
    def fault(self) -> Fault:
        """The latched faults."""
        return Fault(self._head.fault)

    @property
    def snapshot(self) -> list[int]:
        """The whole state as numbers, in the order of ``firmware/host/library.c``."""
        numbers = (ctypes.c_int64 * SNAPSHOT_NUMBERS)()
        self._library.cart_snapshot(self._memory, numbers)
        return list(numbers)

    def receive(self, stuffed: bytes, now_us: int) -> list[bytes]:
        """Handle one frame without its final 0x00; return the answer, at most one frame."""
        length = self._library.cart_receive(self._memory, stuffed, len(stuffed), now_us, self._answer)
        kind = self._head.carried_out
        self.carried_out = MESSAGES[kind].unpack(open_envelope(stuffed).payload) if kind else None
        if isinstance(self.carried_out, SetMotor):
            self._library.cart_delay_command(self._memory, now_us + self._delay_us())
        return self._frames(length)

    @property
    def motor(self) -> int:
        """The motor value in force."""
        return int(self._library.cart_motor(self._memory))

    def drive(self, now_us: int) -> None:
        """Bring the motor values that are due into force."""
        self._library.cart_drive(self._memory, now_us)

    def next_due(self, before_us: int) -> int:
        """Return when the next motor value is due, `before_us` if none is due before that."""
        return int(self._library.cart_next_due(self._memory, before_us))

    def look(self, now_us: int, cart: int, pole: int) -> None:
        """Apply the rules that cannot wait for the end of a period, to the clock and the raw counts."""
        self._library.cart_look(self._memory, now_us, cart, pole)

    def tick(self, now_us: int, cart: int, pole: int) -> list[bytes]:
        """End a period with two raw counts: apply the rules and return the frames to send, STATE last."""
        length = self._library.cart_tick(self._memory, now_us, cart, pole, self._answer)
        self._library.cart_ask_policy(self._memory)
        return self._frames(length)

    def _frames(self, length: int) -> list[bytes]:
        return [frame + END for frame in self._answer.raw[:length].split(END)[:-1]]


def firmware_folder() -> Path:
    """Return the firmware/ folder: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return package / "firmware" if (package / "firmware").is_dir() else package.parent / "firmware"


def find_compiler() -> str:
    """Return the path of the C compiler, $CC if it is set. Raises EmulatorError if there is none."""
    names = (os.environ["CC"],) if os.environ.get("CC") else COMPILERS
    found = next((path for name in names if (path := shutil.which(name))), None)
    if found is None:
        raise EmulatorError(
            f"emulator.firmware=c needs a C compiler, and {' or '.join(names)} was not found: install one, "
            "or use emulator.firmware=python"
        )
    return found


def sources() -> list[Path]:
    """Return the C files of the core, without a board's main loop, and of the shared library."""
    folder = firmware_folder()
    core = [path for path in sorted(folder.glob("src/*.c")) if path.name != "cart_loop.c"]
    return [*core, folder / "host" / "library.c"]


def rig_macros(hardware: Hardware, lever: int = LEVER) -> dict[str, float]:
    """Return the values of the macros in ``firmware/src/cart_rig.h`` for a rig, with a pole's lever in um."""
    values = {name: getattr(hardware, attribute) for name, (attribute, _) in RIG.items() if attribute}
    whole = {name: micrometres(value) for name, value in values.items() if "_UM" in name}
    return {**values, **whole, "CART_POLE_LEVER_UM": lever}


def definitions(hardware: Hardware) -> tuple[str, ...]:
    """Return the compiler's flags for a rig."""
    return tuple(f"-D{name}={value}" for name, value in rig_macros(hardware).items())


def rig_header(hardware: Hardware, source: str, lever: int = LEVER) -> str:
    """Return the text of ``firmware/src/cart_rig.h`` for the rig and pole of `source`, with a lever in um."""
    macros = [
        f"#ifndef {name}\n#define {name} {value} /* {RIG[name][1]} */\n#endif\n"
        for name, value in rig_macros(hardware, lever).items()
    ]
    about = (
        f"/* Encoders, track, motor and pole of {in_comment(source)}."
        " cartpole-export format=firmware writes this file;\n"
        "   flags -D override single numbers. No count is converted: the host needs the same numbers. */\n"
    )
    return f"{about}#ifndef CART_RIG_H\n#define CART_RIG_H\n\n{''.join(macros)}\n#endif\n"


def in_comment(text: str) -> str:
    """Return text as one line within a C comment; it neither ends the comment nor opens another."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def compile_c(output: Path, files: list[Path], *flags: str) -> None:
    """Compile C files of the firmware to `output`. Raises EmulatorError."""
    folder = firmware_folder()
    include = (f"-I{folder / 'src'}", f"-I{folder / 'host'}")
    command = [find_compiler(), *FLAGS, *include, *flags, "-o", str(output), *map(str, files), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise EmulatorError(f"the C firmware was not compiled: {done.stderr.strip() or done.returncode}")


def policy_sources(policy: Path | None) -> list[Path]:
    """Return the C file of an exported agent, none without one. Raises EmulatorError if it is missing."""
    if policy is None:
        return []
    missing = [name for name in ("policy.h", "policy.c") if not (policy / name).is_file()]
    if missing:
        raise EmulatorError(
            f"emulator.policy={policy}: there is no {missing[0]}; give a folder of cartpole-export format=c"
        )
    return [policy.resolve() / "policy.c"]


def build_library(policy: Path | None = None, hardware: Hardware | None = None) -> Path:
    """Return the shared library for a rig, ip02's if it is None, built unless that was built before.

    `policy` is a folder with policy.h and policy.c, of an agent that drives on the board. Raises
    EmulatorError.
    """
    files = [*sources(), *policy_sources(policy)]
    flags = ["-shared", "-fPIC", *definitions(hardware or nominal_hardware())]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cartpole_rl"
    content = hashlib.sha256(" ".join((platform.platform(), find_compiler(), *FLAGS, *flags)).encode())
    read = [*firmware_folder().glob("src/*"), *firmware_folder().glob("host/*")]
    for path in (*sorted(read), *(sorted(policy.glob("policy.[ch]")) if policy else ())):
        content.update(path.read_bytes())
    library = folder / f"firmware-{content.hexdigest()[:16]}.so"
    if not library.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as beside:
            built = Path(beside, library.name)
            if policy:
                flags += ["-DCART_ONBOARD_POLICY", f"-I{policy.resolve()}"]
            compile_c(built, files, *flags)
            built.replace(library)
    return library


def load_library(policy: Path | None = None, hardware: Hardware | None = None) -> ctypes.CDLL:
    """Return the C firmware with the types of its functions. Raises EmulatorError."""
    return _loaded(build_library(policy, hardware))


@functools.cache
def _loaded(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    pointer, size, us = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint64
    signatures = {
        "cart_size": (size, []),
        "cart_boot": (None, [pointer]),
        "cart_policy_size": (size, []),
        "cart_attach_policy": (None, [pointer, pointer, ctypes.c_float]),
        "cart_receive": (size, [pointer, ctypes.c_char_p, size, us, ctypes.c_char_p]),
        "cart_delay_command": (None, [pointer, us]),
        "cart_drive": (None, [pointer, us]),
        "cart_next_due": (us, [pointer, us]),
        "cart_look": (None, [pointer, us, ctypes.c_int32, ctypes.c_int32]),
        "cart_motor": (ctypes.c_int16, [pointer]),
        "cart_tick": (size, [pointer, us, ctypes.c_int32, ctypes.c_int32, ctypes.c_char_p]),
        "cart_ask_policy": (None, [pointer]),
        "cart_runs": (size, [pointer, ctypes.c_char_p, size, ctypes.c_char_p]),
        "cart_snapshot": (None, [pointer, ctypes.POINTER(ctypes.c_int64)]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
