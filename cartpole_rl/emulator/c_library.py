"""Builds the C firmware as a shared library, with the machine's own C compiler, on first use."""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

from cartpole_rl.emulator.encoders import CART_NANOMETRES, POLE_COUNTS, SPAN
from cartpole_rl.emulator.motor_line import MOST_PENDING
from cartpole_rl.errors import EmulatorError

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-ffp-contract=off")
CART = (
    f"-DCART_NANOMETRES={CART_NANOMETRES}",
    f"-DCART_POLE_COUNTS={POLE_COUNTS}",
    f"-DCART_SPAN_UM={round(SPAN * 1e6)}",
    f"-DCART_PENDING={MOST_PENDING}",
)


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


def compile_c(output: Path, files: list[Path], *flags: str) -> None:
    """Compile C files of the firmware to `output`. Raises EmulatorError."""
    folder = firmware_folder()
    include = (f"-I{folder / 'src'}", f"-I{folder / 'host'}")
    command = [find_compiler(), *FLAGS, *CART, *include, *flags, "-o", str(output), *map(str, files), "-lm"]
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


def build_library(policy: Path | None = None) -> Path:
    """Return the shared library, built unless these sources were built before.

    `policy` is a folder with policy.h and policy.c, of an agent that drives on the board. Raises
    EmulatorError.
    """
    files = [*sources(), *policy_sources(policy)]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cartpole_rl"
    content = hashlib.sha256(" ".join((platform.platform(), find_compiler(), *FLAGS, *CART)).encode())
    read = [*firmware_folder().glob("src/*"), *firmware_folder().glob("host/*")]
    for path in (*sorted(read), *(sorted(policy.glob("policy.[ch]")) if policy else ())):
        content.update(path.read_bytes())
    library = folder / f"firmware-{content.hexdigest()[:16]}.so"
    if not library.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as beside:
            built = Path(beside, library.name)
            flags = ("-DCART_ONBOARD_POLICY", f"-I{policy.resolve()}") if policy else ()
            compile_c(built, files, "-shared", "-fPIC", *flags)
            built.replace(library)
    return library


def load_library(policy: Path | None = None) -> ctypes.CDLL:
    """Return the C firmware with the types of its functions. Raises EmulatorError."""
    return _loaded(build_library(policy))


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
