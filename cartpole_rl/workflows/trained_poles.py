"""The poles that an agent was trained with, beside the one that it drives; needs no slow imports."""

from collections.abc import Sequence
from pathlib import Path

import yaml

from cartpole_rl.choices import group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.run_files import COMPARISON, CONFIG

POLES = ("medium", "large")  # in conf/pole/ and conf/emulator/; the first is the default


def known_poles(run: Path, trained: PoleSettings) -> list[PoleSettings]:
    """Return the poles of the training, and the one that the agent was fine-tuned on if `run` did that."""
    if not (run / COMPARISON).is_file():
        return [trained]
    tuning = yaml.safe_load((run / CONFIG).read_text(encoding="utf-8"))
    if tuning["plant"]["kind"] == "emulated":
        return [trained, one_pole(emulated_pole(EmulatorSettings(**tuning["emulator"])))]
    length = tuning["plant"].get("pole_length")
    return [trained, pole_of_length(length, trained)] if length else [trained]


def other_pole(known: Sequence[PoleSettings], driven: PoleSettings, emulated: bool) -> str | None:
    """Return a warning if `driven` has another pole than those that the agent knows, None if not."""
    if knows(known, driven):
        return None
    choice = emulator_for(known[-1]) if emulated else None
    advice = f"; give emulator={choice}" if choice else ""
    length = f"a pole of {' or '.join(map(lengths, known))}, the cart has one of {lengths(driven)}"
    return f"warning: the agent was trained with {length}{advice}"


def knows(known: Sequence[PoleSettings], driven: PoleSettings) -> bool:
    """Return True if each pole that represents `driven` is about one of `known`."""
    each = (driven.each.choices or {}).values()
    return all(any(poles.includes(pole) for poles in known) for pole in each)


def pole_of_length(length: float, trained: PoleSettings) -> PoleSettings:
    """Return the pole of `trained` with about that length (m), or else a uniform rod."""
    for name, pole in (trained.choices or {}).items():
        if pole.is_about(length):
            return PoleSettings(choices={name: pole})
    return one_pole(Pole.rod(length))


def one_pole(pole: Pole) -> PoleSettings:
    """Return the choice of this pole alone, named by its length."""
    return PoleSettings(choices={f"{pole.length:.2f} m": pole})


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
