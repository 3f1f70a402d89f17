"""Statistics of a serial link: counts of frames, and the time from a state to its command.

The host's own share of that time is measured with the host's clock, to the microsecond. The whole, from the
measurement to the arrival of the command at the cart, is measured by the cart: its STATEs have the age of the
newest command.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import PlantError

LATENCY_SAMPLES = 65536  # the newest 22 minutes at 50 Hz; 512 KiB


class LatencyRing:
    """The newest `LATENCY_SAMPLES` times in seconds. Its memory does not grow."""

    def __init__(self) -> None:
        self._seconds = np.zeros(LATENCY_SAMPLES)
        self._added = 0

    def add(self, seconds: float) -> None:
        """Store one time; when the ring is full, it replaces the oldest."""
        self._seconds[self._added % LATENCY_SAMPLES] = seconds
        self._added += 1

    def samples(self) -> NDArray[np.float64]:
        """Return the stored times in s, in no particular order, shape [0 to LATENCY_SAMPLES]."""
        return self._seconds[: min(self._added, LATENCY_SAMPLES)].copy()

    def clear(self) -> None:
        """Forget every time."""
        self._added = 0


@dataclass(frozen=True)
class LinkSummary:
    """`LinkStatistics` at one moment; times in ms, from the arrival of a state to the end of its command."""

    frames_received: int
    bad_frames: int
    lost_frames: int
    overtaken_frames: int
    repeated_frames: int
    late_ticks: int
    latency_samples: int
    latency_median_ms: float  # nan without samples, as the three below
    latency_p99_ms: float
    latency_p999_ms: float
    latency_max_ms: float


@dataclass
class LinkStatistics:
    """Running counts of one cart over all its connections, without those made while opening a port."""

    frames_received: int = 0  # whole frames of the cart, of every type
    bad_frames: int = 0  # bytes between two 0x00 that are not a frame: checksum, stuffing, type, length
    lost_frames: int = 0  # states that never arrived whole, by the gaps in STATE's tick
    overtaken_frames: int = 0  # states that arrived after a newer one, and were dropped
    repeated_frames: int = 0  # states that arrived once more, and were dropped
    late_ticks: int = 0  # states passed over, or answered later than a period after they came
    latency: LatencyRing = field(default_factory=LatencyRing)
    loop_times: LatencyRing = field(default_factory=LatencyRing)  # see `loop`

    def summary(self) -> LinkSummary:
        """Return the counts, and the median, 99th and 99.9th percentile and maximum of the latency."""
        times = self.latency.samples() * 1e3
        percentiles = np.percentile(times, (50, 99, 99.9, 100)) if len(times) else np.full(4, np.nan)
        median, p99, p999, longest = percentiles.tolist()
        return LinkSummary(
            self.frames_received,
            self.bad_frames,
            self.lost_frames,
            self.overtaken_frames,
            self.repeated_frames,
            self.late_ticks,
            len(times),
            median,
            p99,
            p999,
            longest,
        )

    def loop(self, share: float = 0.98) -> tuple[float, float]:
        """Return [low, high] in s, between which the middle `share` of the loop times lie.

        A loop time is the time from a state's measurement to the arrival of its command, by the cart's
        clock: the wire both ways and the host between. The time from there to a force at the cart is not
        included; `cartpole-preflight` measures it as `latency`. Raises PlantError without a sample,
        ValueError for a share outside 0 to 1.
        """
        if not 0 <= share <= 1:
            raise ValueError(f"a share is between 0 and 1, not {share:g}")
        times = self.loop_times.samples()
        if not len(times):
            raise PlantError("no latency was measured yet: drive the cart first")
        low, high = np.quantile(times, ((1 - share) / 2, (1 + share) / 2)).tolist()
        return low, high

    def latency_override(self) -> str | None:
        """Return the measured loop times as a setting on the command line of `cartpole-train`.

        None without a sample, or if every command came at once, as with a lockstep emulator.
        """
        if not len(self.loop_times.samples()):
            return None
        low, high = (round(seconds, 4) for seconds in self.loop())
        if high <= 0:
            return None
        return f"++randomization.latency={{distribution: uniform, absolute: [{low}, {high}]}}"

    def clear(self) -> None:
        """Reset all counts."""
        self.frames_received = self.bad_frames = self.lost_frames = self.late_ticks = 0
        self.overtaken_frames = self.repeated_frames = 0
        self.latency.clear()
        self.loop_times.clear()
