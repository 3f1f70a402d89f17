"""Texts that several figures, tables and messages share."""

from collections.abc import Iterator, Sequence

from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode

ENDINGS = {
    Ending.TIME: "time was up",
    Ending.TRACK: "left the track",
    Ending.ANGLE: "the pole fell",
    Ending.FAULT: "the cart reported a fault",
    Ending.LINK: "the link was lost",
    Ending.NON_FINITE: "a value was not finite",
}
PHYSICS, LEARNED = "physics alone", "physics + network"  # models that are compared


def count_text(episodes: int) -> str:
    """Return "1 episode" or "20 episodes"."""
    return f"{episodes} episode{'' if episodes == 1 else 's'}"


def guard_text(*episodes: Episode) -> str:
    """Return ", guarded 3.2 %", the mean share of periods under the track guard; empty without one."""
    shares = [episode.guarded.mean() for episode in episodes if episode.guarded is not None]
    return f", guarded {100 * sum(shares) / len(shares):.1f} %" if shares else ""


def cut_off(episodes: Sequence[Episode]) -> Iterator[str]:
    """Yield a warning for each fault that ended episodes early; their scores count in the means."""
    for ending in (Ending.LINK, Ending.FAULT, Ending.NON_FINITE):
        if count := sum(episode.ended_by == ending for episode in episodes):
            yield f"warning: {count} of {count_text(len(episodes))} ended early by {ending} (docs/safety.md)"


def ending_text(episode: Episode) -> str:
    """Return why and when an episode ended: "left the track after 6.6 s"."""
    return f"{ENDINGS[Ending(episode.ended_by)]} after {episode.time[-1] - episode.time[0]:.1f} s"
