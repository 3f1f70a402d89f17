"""Which poles an agent knows, and which emulated cart has one of them."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.choices import group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.run_files import COMPARISON, CONFIG
from cartpole_rl.workflows.trained_poles import (
    emulated_pole,
    emulated_words,
    known_poles,
    other_pole,
    pole_of_length,
)

POLES = group_choices("pole")
MEDIUM, LARGE, BOTH = (PoleSettings(**POLES[name]) for name in ("medium", "large", "both"))
RODS = PoleSettings(lengths=(0.2, 1.0))
EMULATED = PoleSettings(choices={"0.35 m": Pole(pole_mass=0.13, pole_com=0.177, pole_inertia=1.2e-3)})


@pytest.mark.parametrize(
    ("trained", "words"),
    [
        (MEDIUM, "plant=emulated"),
        (LARGE, "plant=emulated emulator=large"),
        (BOTH, "plant=emulated"),
        (RODS, "plant=emulated"),
        (PoleSettings(lengths=(0.8, 1.0)), "plant=emulated"),
    ],
)
def test_the_emulated_cart_has_a_pole_that_the_agent_knows(trained: PoleSettings, words: str) -> None:
    assert emulated_words(trained) == words


@pytest.mark.parametrize("trained", [MEDIUM, BOTH, RODS, PoleSettings(lengths=(0.2, 0.35))])
def test_a_known_pole_gets_no_warning(trained: PoleSettings) -> None:
    assert other_pole([trained], EMULATED, emulated=True) is None


def test_another_pole_gets_a_warning_with_the_emulated_cart_to_choose() -> None:
    line = "warning: the agent was trained with a pole of 0.66 m, the cart has one of 0.35 m"
    assert other_pole([LARGE], EMULATED, emulated=True) == f"{line}; give emulator=large"
    assert other_pole([LARGE], EMULATED, emulated=False) == line


def test_each_pole_of_several_is_looked_at() -> None:
    line = "warning: the agent was trained with a pole of 0.36 m, the cart has one of 0.36 m or 0.66 m"
    assert other_pole([MEDIUM], BOTH, emulated=False) == line


def test_rods_outside_the_trained_lengths_are_others() -> None:
    line = "warning: the agent was trained with a pole of 0.2 to 0.3 m, the cart has one of 0.35 m"
    assert other_pole([PoleSettings(lengths=(0.2, 0.3))], EMULATED, emulated=False) == line


def tuning(folder: Path, plant: dict[str, Any], **emulator: Any) -> Path:
    """The run folder of a fine-tuning that has ended."""
    (folder / COMPARISON).write_text("{}")
    (folder / CONFIG).write_text(yaml.safe_dump({"plant": plant, "emulator": emulator}))
    return folder


def test_a_training_and_a_checkpoint_know_the_poles_of_the_training(tmp_path: Path) -> None:
    assert known_poles(tmp_path, MEDIUM) == [MEDIUM]
    assert known_poles(tmp_path / "checkpoints/last.pt", MEDIUM) == [MEDIUM]


def test_a_fine_tuned_agent_knows_the_pole_of_its_emulated_cart(tmp_path: Path) -> None:
    large = group_choices("emulator")["large"]
    driven = PoleSettings(choices={"0.66 m": emulated_pole(EmulatorSettings(**large))})
    assert other_pole([MEDIUM], driven, emulated=True) is not None
    known = known_poles(tuning(tmp_path, {"kind": "emulated"}, **large), MEDIUM)
    assert other_pole(known, driven, emulated=True) is None
    assert emulated_words(known[-1]) == "plant=emulated emulator=large"


@pytest.mark.parametrize(("length", "count"), [(None, 1), (0.66, 2)])
def test_a_fine_tuned_agent_knows_the_stated_length_of_its_cart(
    length: float | None, count: int, tmp_path: Path
) -> None:
    known = known_poles(tuning(tmp_path, {"kind": "serial", "pole_length": length}), MEDIUM)
    assert len(known) == count
    assert (other_pole(known, LARGE, emulated=False) is None) == (length is not None)


def test_a_stated_length_is_that_of_a_trained_pole_or_of_a_rod() -> None:
    assert pole_of_length(0.64, BOTH) == LARGE
    assert pole_of_length(0.64, MEDIUM).nominal == Pole.rod(0.64)
    line = "warning: the agent was trained with a pole of 0.36 m, the cart has one of 0.64 m"
    assert other_pole([MEDIUM], pole_of_length(0.64, MEDIUM), emulated=False) == line
