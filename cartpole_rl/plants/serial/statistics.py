"""Statistics of a serial link: counts of frames, and the time from a state to its command.

The host's own share of that time is measured with the host's clock, to the microsecond. The whole, from the
measurement to the arrival of the command at the cart, is measured by the cart: its STATEs have the age of the
newest command.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

LATENCY_SAMPLES = 65536  # the newest 22 minutes at 50 Hz
MIDDLE = (0.01, 0.99)  # quantiles of the loop times


def latency_queue() -> deque[float]:
    """Return an empty queue of the newest `LATENCY_SAMPLES` times in s. Its memory does not grow."""
    return deque(maxlen=LATENCY_SAMPLES)


@dataclass
class LinkStatistics:
    """Running counts of one cart over all its connections, without those made while opening a port."""

    frames_received: int = 0  # whole frames of the cart, of every type
    bad_frames: int = 0  # bytes between two 0x00 that are not a frame: checksum, stuffing, type, length
    lost_frames: int = 0  # states that never arrived whole, by the gaps in STATE's tick
    overtaken_frames: int = 0  # states that arrived after a newer one, and were dropped
    repeated_frames: int = 0  # states that arrived once more, and were dropped
    late_ticks: int = 0  # states passed over, or answered later than a period after they came
    latency: deque[float] = field(default_factory=latency_queue)  # s, from a state to its command's end
    loop_times: deque[float] = field(default_factory=latency_queue)  # s, see `latency_override`

    def summary(self) -> dict[str, float]:
        """Return the counts, and the median, 99th and 99.9th percentile and maximum of the latency in ms.

        The latter are NaN without a sample.
        """
        counts = {name: value for name, value in vars(self).items() if isinstance(value, int)}
        times = 1e3 * np.array(self.latency)
        percentiles = np.percentile(times, (50, 99, 99.9, 100)) if len(times) else np.full(4, np.nan)
        keys = "latency_median_ms", "latency_p99_ms", "latency_p999_ms", "latency_max_ms"
        return {**counts, "latency_samples": len(times), **dict(zip(keys, percentiles.tolist(), strict=True))}

    def latency_override(self) -> str | None:
        """Return the range of the middle 98 % of the loop times as a setting of `cartpole-train`.

        A loop time is the time from a state's measurement to the arrival of its command, by the cart's
        clock: the wire both ways and the host between. The time from there to a force at the cart is not
        included; `cartpole-preflight` measures it as `latency`. None without a sample, or if every command
        came at once, as with a lockstep emulator.
        """
        if not self.loop_times:
            return None
        low, high = (round(seconds, 4) for seconds in np.quantile(self.loop_times, MIDDLE).tolist())
        if high <= 0:
            return None
        return f"++randomization.latency={{distribution: uniform, absolute: [{low}, {high}]}}"

    def clear(self) -> None:
        """Reset all counts."""
        self.frames_received = self.bad_frames = self.lost_frames = self.late_ticks = 0
        self.overtaken_frames = self.repeated_frames = 0
        self.latency.clear()
        self.loop_times.clear()
