"""The host's clock for everything that waits for a cart: it goes on while the computer sleeps.

`time.perf_counter` stands still then on Linux and macOS: a state from before the sleep would look
new, and the motor value that answers it would be sent.
"""

import time

# Linux's has this name; macOS counts the time asleep in its CLOCK_MONOTONIC, and Windows in perf_counter
_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def now() -> float:
    """Return s since an arbitrary moment, with the time asleep."""
    return time.perf_counter() if _CLOCK is None else time.clock_gettime(_CLOCK)
