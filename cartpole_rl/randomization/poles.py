"""The pole of a cart: one, one of several, or a rod of random length. A pole is chosen whole."""

from typing import Any

from pydantic import model_validator

from cartpole_rl.choices import group_choices
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import NonNegative, Positive, Settings

# From the thesis (6.4). Quanser's poles have half of it, 0.127 kg on 0.3365 m and 0.230 kg on 0.6413 m:
# 0.7 kg/m is their mass over the distance from pivot to centre of mass.
POLE_DENSITY = 0.7  # kg/m
SIMILAR = 0.1  # largest relative difference between two lengths of the same pole
HEAVIER = 1.2  # times the mass of a pole of the same length: full motor brakes it noticeably later
JUDGED_LENGTHS = 5  # rods on which an agent of a range of lengths is evaluated


def uniform_rod(length: Any) -> dict[str, Any]:
    """Return mass, centre of mass and inertia of a rod of POLE_DENSITY: its length sets all three.

    `length` m is a float or a tensor, and so are the three.
    """
    mass = POLE_DENSITY * length
    return {"pole_mass": mass, "pole_com": length / 2, "pole_inertia": mass * length**2 / 12}


class Pole(Settings):
    """A rigid pole."""

    pole_mass: Positive  # kg
    pole_com: Positive  # m, pivot to centre of mass
    pole_inertia: NonNegative  # kg m^2, about the centre of mass

    @classmethod
    def rod(cls, length: float) -> "Pole":
        """Return a uniform rod of `length` m and the thesis's 0.7 kg/m."""
        return cls(**uniform_rod(length))

    @property
    def length(self) -> float:
        """The length of a uniform rod with the same centre of mass, m."""
        return 2 * self.pole_com

    def is_about(self, length: float) -> bool:
        """Return True where a pole of `length` m may be this one, since lengths are measured by hand."""
        return abs(length / self.length - 1) < SIMILAR


class PoleSettings(Settings):
    """`choices` by name, one drawn an episode, or `lengths` [low, high) in m of a uniform rod.

    Choices `in_turn` are not drawn: each cart carries the next one, and the first one follows the last.
    """

    choices: dict[str, Pole] | None = None
    lengths: tuple[Positive, Positive] | None = None
    in_turn: bool = False

    @model_validator(mode="after")
    def _one_way(self) -> "PoleSettings":
        if (self.choices is None) == (self.lengths is None):
            raise ValueError("give either choices or lengths")
        if self.choices is not None and not self.choices:
            raise ValueError("choices names no pole")
        if self.lengths is not None and not self.lengths[0] < self.lengths[1]:
            raise ValueError(f"lengths {list(self.lengths)} must rise")
        return self

    @property
    def nominal(self) -> Pole:
        """The pole that represents the whole choice: the first one, or the rod of middle length."""
        if self.choices is not None:
            return next(iter(self.choices.values()))
        assert self.lengths is not None
        return Pole.rod(sum(self.lengths) / 2)

    @property
    def is_single(self) -> bool:
        """True if every cart carries the same pole."""
        return self.choices is not None and len(self.choices) == 1

    def includes(self, pole: Pole) -> bool:
        """Return True if `pole` is about one of these."""
        if self.choices is not None:
            return any(each.is_about(pole.length) for each in self.choices.values())
        assert self.lengths is not None
        low, high = self.lengths
        return low * (1 - SIMILAR) < pole.length < high * (1 + SIMILAR)

    @property
    def each(self) -> "PoleSettings":
        """The poles that represent the choice: every choice, or rods from the shortest to the longest."""
        if self.choices is not None:
            return PoleSettings(choices=self.choices, in_turn=True)
        assert self.lengths is not None
        low, high = self.lengths
        lengths = [low + (high - low) * index / (JUDGED_LENGTHS - 1) for index in range(JUDGED_LENGTHS)]
        rods = {f"{length:.2f} m": Pole.rod(length) for length in lengths}
        return PoleSettings(choices=rods, in_turn=True)

    @property
    def name(self) -> str:
        """For tables and file names: "medium", "medium or large", "0.2 to 1 m"."""
        if self.choices is not None:
            return " or ".join(self.choices)
        assert self.lengths is not None
        return f"{self.lengths[0]:g} to {self.lengths[1]:g} m"


def possible_poles(poles: PoleSettings) -> list[Pole]:
    """Return the choices; the rod of middle length represents rods of random length."""
    return [poles.nominal] if poles.choices is None else list(poles.choices.values())


def check_one_pole(owner: str, poles: PoleSettings) -> Pole:
    """Return the pole. Raises ConfigError, which names `owner`, if there are several `poles`."""
    if not poles.is_single:
        raise ConfigError(f"pole: {owner} takes one pole, not {poles.name}; choose one, as pole=medium")
    return poles.nominal


def one_pole(pole: Pole) -> PoleSettings:
    """Return the choice of this pole alone, named by its length."""
    return PoleSettings(choices={f"{pole.length:.2f} m": pole})


def pole_of_length(length: float, trained: PoleSettings) -> PoleSettings:
    """Return the pole of `trained` with about `length` m, else that of `pole=both`, else a uniform rod."""
    known = trained if trained.includes(Pole.rod(length)) else PoleSettings(**group_choices("pole")["both"])
    alike = {name: pole for name, pole in (known.choices or {}).items() if pole.is_about(length)}
    if not alike:
        return one_pole(Pole.rod(length))
    nearest = min(alike, key=lambda name: abs(alike[name].length - length))
    return PoleSettings(choices={nearest: alike[nearest]})
