"""The poles that an agent was trained with, beside the one that it drives; needs no slow imports."""

from cartpole_rl.choices import group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings

POLES = ("medium", "large")  # in conf/pole/ and conf/emulator/; the first is the default


def other_pole(trained: PoleSettings, driven: PoleSettings, emulated: bool) -> str | None:
    """Return a warning if the agent was trained with other poles than those `driven`, None if not."""
    if knows(trained, driven):
        return None
    known = emulator_for(trained) if emulated else None
    advice = f"; give emulator={known}" if known else ""
    length = f"a pole of {lengths(trained)}, the cart has one of {lengths(driven)}"
    return f"warning: the agent was trained with {length}{advice}"


def knows(trained: PoleSettings, driven: PoleSettings) -> bool:
    """Return True if each pole that represents `driven` is about one of `trained`."""
    return all(trained.includes(pole) for pole in (driven.each.choices or {}).values())


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
    files = group_choices("emulator")  # without the first, which is in code
    for name in POLES:
        if poles.includes(emulated_pole(EmulatorSettings(**files.get(name, {})))):
            return name
    return None


def emulated_pole(truth: EmulatorSettings) -> Pole:
    """Return the pole of an emulated cart."""
    return Pole(**truth.model_dump(include=set(Pole.model_fields)))
