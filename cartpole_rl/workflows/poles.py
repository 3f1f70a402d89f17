"""The pole of a simulated cart that is compared with recordings."""

from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.recordings import LENGTH, read_heading
from cartpole_rl.randomization.poles import Pole, PoleSettings, check_one_pole
from cartpole_rl.workflows.trained_poles import POLES


def chosen_pole(owner: str, poles: PoleSettings | None, paths: Sequence[Path]) -> tuple[str, Pole]:
    """Return name and parameters of the pole in `poles`; without a choice, of the recorded one.

    Raises ConfigError where `poles` are several, naming `owner`, and what `recorded_pole` raises.
    """
    if poles is None:
        return recorded_pole(paths)
    return poles.name, check_one_pole(owner, poles)


def recorded_pole(paths: Sequence[Path]) -> tuple[str, Pole]:
    """Return the one of POLES with the recorded length; the first where no recording states its length.

    Raises ConfigError for several lengths or the length of another pole, RecordingError for a damaged header.
    """
    known = {name: Pole(**choice(f"pole/{name}")["choices"][name]) for name in POLES}
    lengths = sorted({length for path in paths if (length := recorded_length(path))})
    if not lengths:
        return POLES[0], known[POLES[0]]
    if len(lengths) > 1:
        several = ", ".join(f"{length:g}" for length in lengths)
        raise ConfigError(f"pole: poles of {several} m were recorded; replay those of one pole at a time")
    (length,) = lengths
    for name, pole in known.items():
        if pole.is_about(length):
            return name, pole
    raise ConfigError(f"pole: one of {length:g} m was recorded; give pole=medium, large or your own")


def recorded_length(path: Path) -> float | None:
    """Return the pole's length (m) in a recording's header; None where it has none. Raises RecordingError."""
    text = read_heading(path)[0].get(LENGTH)
    try:
        return float(text) if text else None
    except ValueError:
        raise RecordingError(f"{path} is damaged: {LENGTH} is {text!r}, and not a number") from None
