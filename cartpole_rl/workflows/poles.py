"""Which pole a cart has: the recorded one, or one that the agent was trained with."""

from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.recordings import LENGTH
from cartpole_rl.randomization.checks import check_one_pole
from cartpole_rl.randomization.poles import Pole, PoleSettings

POLES = ("medium", "large")  # in conf/pole/ and conf/emulator/; the first is the default


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
    with path.open(encoding="utf-8") as file:
        pairs = (line[1:].partition(":") for line in file if line.startswith("#"))
        text = {key.strip(): value.strip() for key, _, value in pairs}.get(LENGTH)
    try:
        return float(text) if text else None
    except ValueError:
        raise RecordingError(f"{path} is damaged: {LENGTH} is {text!r}, and not a number") from None


def other_pole(trained: PoleSettings, driven: PoleSettings, emulated: bool) -> str | None:
    """Return a warning if the agent was trained with other poles than those `driven`, None if not."""
    if all(trained.includes(pole) for pole in (driven.each.choices or {}).values()):
        return None
    known = emulator_for(trained) if emulated else None
    advice = f"; give emulator={known}" if known else ""
    length = f"a pole of {lengths(trained)}, the cart has one of {lengths(driven)}"
    return f"warning: the agent was trained with {length}{advice}"


def lengths(poles: PoleSettings) -> str:
    """Return the lengths in m for a message."""
    if poles.choices is None:
        return poles.name
    return " or ".join(f"{pole.length:.2f} m" for pole in poles.choices.values())


def emulated_words(poles: PoleSettings) -> str:
    """Return the words that choose an emulated cart with one of `poles`, if there is one."""
    known = emulator_for(poles)
    return f"plant=emulated emulator={known}" if known and known != POLES[0] else "plant=emulated"


def emulator_for(poles: PoleSettings) -> str | None:
    """Return the first of POLES whose emulated cart has one of `poles`."""
    for name in POLES:
        values = {} if name == POLES[0] else choice(f"emulator/{name}")
        truth = EmulatorSettings(**{field: values[field] for field in Pole.model_fields if field in values})
        if poles.includes(Pole(**truth.model_dump(include=set(Pole.model_fields)))):
            return name
    return None
