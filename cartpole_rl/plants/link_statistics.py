"""What a serial link has been through: frames counted, and the host's time from a state to its command."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

LATENCY_SAMPLES = 4096  # the newest 82 s at 50 Hz


class LatencyRing:
    """The newest `LATENCY_SAMPLES` times in seconds. Memory is taken once and does not grow."""

    def __init__(self) -> None:
        self._seconds = np.zeros(LATENCY_SAMPLES)
        self._added = 0

    def add(self, seconds: float) -> None:
        """Store one time; the oldest is overwritten when the ring is full."""
        self._seconds[self._added % LATENCY_SAMPLES] = seconds
        self._added += 1

    def samples(self) -> NDArray[np.float64]:
        """The stored times in s, in no particular order, shape [0 to LATENCY_SAMPLES]."""
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
    late_ticks: int
    latency_samples: int
    latency_median_ms: float  # nan without samples, as the two below
    latency_p99_ms: float
    latency_max_ms: float


@dataclass
class LinkStatistics:
    """Running counts since the link was opened, or since `clear`."""

    frames_received: int = 0  # whole frames of the cart, of every type
    bad_frames: int = 0  # bytes between two 0x00 that are no frame: checksum, stuffing, type, length
    lost_frames: int = 0  # states that never arrived whole, by the gaps in STATE's tick
    late_ticks: int = 0  # states that came while the host was busy with an older one
    latency: LatencyRing = field(default_factory=LatencyRing)

    def summary(self) -> LinkSummary:
        """The counts and the latency's median, 99th percentile and maximum."""
        times = self.latency.samples() * 1e3
        median, p99, longest = np.percentile(times, (50, 99, 100)) if len(times) else (np.nan,) * 3
        return LinkSummary(
            self.frames_received,
            self.bad_frames,
            self.lost_frames,
            self.late_ticks,
            len(times),
            float(median),
            float(p99),
            float(longest),
        )

    def clear(self) -> None:
        """Begin to count anew."""
        self.frames_received = self.bad_frames = self.lost_frames = self.late_ticks = 0
        self.latency.clear()
