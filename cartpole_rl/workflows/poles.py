"""The poles of agents, carts and recordings, and the words that choose a cart with one of them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, TypeAdapter

from cartpole_rl.choices import choice, group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.settings import PlantSettings, PortSettings, changed_words, emulated_pole
from cartpole_rl.randomization.poles import HEAVIER, Pole, PoleSettings, check_one_pole, one_pole
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.run_folder import recorded_config

if TYPE_CHECKING:
    from cartpole_rl.evaluation.recordings import Recording  # imports PyTorch

PRETRAINED = ("medium", "large")  # poles of pretrained agents; the first is the default
# settings of an emulated cart that are those of one run
NOT_OF_CART = {"policy": None, "given": (), "knock": 0.0, "journal": None}
POLES = (*PRETRAINED, "rod_03", "sensorsini", "laboratorio")  # in conf/pole/ and conf/emulator/


def other_pole(known: Sequence[PoleSettings], driven: PoleSettings, emulated: bool) -> str | None:
    """Return a warning if `driven` has another pole than those that the agent knows, None if not."""
    if knows(known, driven):
        return other_mass(known, driven)
    choice = emulator_for(known) if emulated else None
    advice = f"; give emulator={choice}" if choice else ""
    trained, own = " or ".join(dict.fromkeys(map(lengths, known))), lengths(driven)
    return f"warning: the agent was trained with a pole of {trained}, the cart has one of {own}{advice}"


def other_mass(known: Sequence[PoleSettings], driven: PoleSettings) -> str | None:
    """Return a warning if a pole of `driven` is as long as a known one, but of another mass; None if not."""
    if any(poles.choices is None for poles in known):  # rods of random length
        return None
    for pole in (driven.each.choices or {}).values():
        each_known = (each for poles in known for each in (poles.choices or {}).values())
        alike = [each.pole_mass for each in each_known if each.is_about(pole.length)]
        if not any(1 / HEAVIER < pole.pole_mass / mass < HEAVIER for mass in alike):
            trained = " or ".join(f"{mass:.3g} kg" for mass in dict.fromkeys(alike))
            own = f"{pole.pole_mass:.3g} kg"
            return f"warning: the agent was trained with a pole of {trained}, the cart has one of {own}"
    return None


def knows(known: Sequence[PoleSettings], driven: PoleSettings) -> bool:
    """Return True if each pole that represents `driven` is about one of `known`."""
    each = (driven.each.choices or {}).values()
    return all(any(poles.includes(pole) for poles in known) for pole in each)


def guard_holds(trained: PoleSettings, driven: PoleSettings) -> bool:
    """Return True if a track guard that is fitted to `trained` is one for the poles of `driven`, too."""
    each = (driven.each.choices or {}).values()
    return knows([trained], driven) and all(pole.pole_mass < heaviest(trained, pole.length) for pole in each)


def heaviest(trained: PoleSettings, length: float) -> float:
    """Return the mass from which a pole of `length` m is another one than those of `trained`, kg."""
    alike = [pole.pole_mass for pole in (trained.choices or {}).values() if pole.is_about(length)]
    return HEAVIER * max(alike, default=Pole.rod(length).pole_mass)


def pole_text(poles: PoleSettings) -> str:
    """Return the length and the mass of each pole for a message."""
    each = (poles.choices or {}).values()
    return " or ".join(f"{pole.length:.2f} m, {pole.pole_mass:.3g} kg" for pole in each) or poles.name


def lengths(poles: PoleSettings) -> str:
    """Return the lengths in m for a message."""
    return " or ".join(f"{pole.length:.2f} m" for pole in (poles.choices or {}).values()) or poles.name


def emulated_words(known: Sequence[PoleSettings]) -> str:
    """Return the words that choose an emulated cart with one of the `known` poles, if there is one."""
    choice = emulator_for(known)
    return f"plant=emulated emulator={choice}" if choice and choice != POLES[0] else "plant=emulated"


def emulator_for(known: Sequence[PoleSettings]) -> str | None:
    """Return the one of POLES whose emulated cart has one of the `known` poles, the newest first."""
    files = group_choices("emulator")  # without the first, which is in code
    emulated = {name: emulated_pole(EmulatorSettings(**files.get(name, {}))) for name in POLES}
    for poles in reversed(known):
        if names := [name for name, pole in emulated.items() if poles.includes(pole)]:
            mass = emulated[names[0]].pole_mass if poles.choices is None else poles.nominal.pole_mass
            return min(names, key=lambda name: abs(math.log(emulated[name].pole_mass / mass)))
    return None


def plant_words(
    plant: PlantSettings, emulator: EmulatorSettings | None = None, known: Sequence[PoleSettings] = ()
) -> str:
    """Return the words that choose the same cart on the command line.

    An emulated cart whose pole was not chosen gets one of the `known` poles.
    """
    if not plant.reads_emulator or emulator is None:
        return plant.words
    files = {name: EmulatorSettings(**file) for name, file in group_choices("emulator").items()}
    default, pole, cart = EmulatorSettings(), emulated_pole(emulator), emulator.cart
    if known and pole == emulated_pole(default) and not knows(known, one_pole(pole)):
        chosen = files.get(emulator_for(known) or "", default)
        pole, cart = emulated_pole(chosen), cart or chosen.cart
    driven = emulator.model_copy(update={**pole.model_dump(), "cart": cart, **NOT_OF_CART})
    choices = [
        [f"emulator={name}"] * bool(name) + changed_words("emulator", driven, file.model_dump())
        for name, file in {"": default, **files}.items()
    ]
    return " ".join([plant.words, *min(choices, key=len)])


def words_of_run(folder: Path) -> str | None:
    """Return the words of the cart that the recordings of a run in `folder` are of; None if it is unknown."""
    content = recorded_config(folder)
    try:
        if content.get("from"):
            return words_of_run(Path(content["from"]))
        plant = TypeAdapter(Annotated[PortSettings, Field(discriminator="kind")])
        return plant_words(plant.validate_python(content["plant"]), EmulatorSettings(**content["emulator"]))
    except (ValueError, KeyError, TypeError):
        return None


def chosen_pole(
    owner: str, poles: PoleSettings | None, recordings: Sequence["Recording"], own: PoleSettings | None = None
) -> tuple[str, Pole]:
    """Return name and parameters of the pole in `poles`; without a choice, of the recorded one, as in `own`.

    A chosen pole with another length than the recorded one is warned of. Raises ConfigError where `poles` are
    several, naming `owner`, and what `recorded_pole` raises.
    """
    if poles is None:
        return recorded_pole(recordings, own.choices if own else None)
    pole = check_one_pole(owner, poles)
    warn_of_another_pole(pole, recordings)
    return poles.name, pole


def warn_of_another_pole(pole: Pole, recordings: Iterable["Recording"]) -> None:
    """Print a warning where a recording states the length of another pole. Raises RecordingError."""
    recorded = {length for each in recordings if (length := each.pole_length)}
    if others := [f"{length:g} m" for length in sorted(recorded) if not pole.is_about(length)]:
        print(f"warning: a pole of {' and '.join(others)} was recorded; pole= gives one of {pole.length:g} m")


def recorded_pole(
    recordings: Sequence["Recording"], own: Mapping[str, Pole] | None = None
) -> tuple[str, Pole]:
    """Return the one of `own` or POLES with the recorded length; the first where no recording states it.

    Raises ConfigError for several lengths, the length of another pole, or none with other encoders than
    ip02's, and RecordingError for a damaged one.
    """
    shipped = {name: Pole(**choice(f"pole/{name}")["choices"][name]) for name in POLES}
    known = {**(own or {}), **{name: pole for name, pole in shipped.items() if name not in (own or {})}}
    lengths = sorted({length for each in recordings if (length := each.pole_length)})
    if not lengths:
        if recordings[0].episode.encoders != nominal_encoders():
            raise ConfigError("pole: the recordings do not say which one it is; give the pole of this cart")
        return next(iter(known.items()))
    for name, pole in known.items():
        if all(map(pole.is_about, lengths)):
            return name, pole
    several = ", ".join(f"{length:g}" for length in lengths)
    if len(lengths) > 1:
        raise ConfigError(f"pole: poles of {several} m were recorded; replay those of one pole at a time")
    raise ConfigError(f"pole: one of {several} m was recorded; give one of {', '.join(POLES)}, or your own")
