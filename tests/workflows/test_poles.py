"""Which poles an agent knows, and the words that choose a cart."""

import shlex
from pathlib import Path

import pytest

from cartpole_rl.choices import choice, group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.settings import EmulatedSettings, SerialSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings, one_pole, pole_of_length
from cartpole_rl.run_folder import write_config
from cartpole_rl.workflows.build import with_shaking_pole
from cartpole_rl.workflows.config import IdentifyConfig, load_settings
from cartpole_rl.workflows.poles import emulated_words, other_pole, plant_words, words_of_run

POLES = group_choices("pole")
MEDIUM, LARGE, BOTH = (PoleSettings(**POLES[name]) for name in ("medium", "large", "both"))
RODS = PoleSettings(lengths=(0.2, 1.0))
ROD = one_pole(Pole.rod(0.5))
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
    assert emulated_words([trained]) == words


def test_another_pole_gets_a_warning_with_the_emulated_cart_to_choose() -> None:
    line = "warning: the agent was trained with a pole of 0.66 m, the cart has one of 0.35 m"
    assert other_pole([LARGE], EMULATED, emulated=True) == f"{line}; give emulator=large"
    assert other_pole([LARGE], EMULATED, emulated=False) == line


@pytest.mark.parametrize("mass", [0.05, 0.3])
def test_a_pole_of_the_same_length_and_another_mass_gets_a_warning(mass: float) -> None:
    pole = MEDIUM.nominal.model_copy(update={"pole_mass": mass})
    line = f"warning: the agent was trained with a pole of 0.127 kg, the cart has one of {mass} kg"
    assert other_pole([MEDIUM, LARGE], one_pole(pole), emulated=True) == line
    assert other_pole([MEDIUM, one_pole(pole)], one_pole(pole), emulated=True) is None
    assert other_pole([MEDIUM], EMULATED, emulated=True) is None
    assert other_pole([RODS], one_pole(pole), emulated=True) is None


def test_rods_outside_the_trained_lengths_are_others() -> None:
    line = "warning: the agent was trained with a pole of 0.2 to 0.3 m, the cart has one of 0.35 m"
    assert other_pole([PoleSettings(lengths=(0.2, 0.3))], EMULATED, emulated=False) == line


def test_the_pole_of_a_fine_tuning_comes_first() -> None:
    assert emulated_words([MEDIUM, LARGE]) == "plant=emulated emulator=large"
    assert emulated_words([LARGE, ROD]) == "plant=emulated emulator=large"
    line = "warning: the agent was trained with a pole of 0.66 m or 0.50 m, the cart has one of 0.35 m"
    assert other_pole([LARGE, ROD], EMULATED, emulated=True) == f"{line}; give emulator=large"


def test_a_stated_length_is_that_of_a_trained_pole_or_of_a_shipped_one_or_of_a_rod() -> None:
    assert pole_of_length(0.64, BOTH) == LARGE
    assert pole_of_length(0.64, MEDIUM) == LARGE
    assert pole_of_length(0.64, RODS).nominal == Pole.rod(0.64)
    assert pole_of_length(0.5, MEDIUM).nominal == Pole.rod(0.5)
    similar = PoleSettings(choices={"0.60 m": Pole.rod(0.6), "0.64 m": Pole.rod(0.64)})
    assert pole_of_length(0.63, similar).name == "0.64 m"
    line = "warning: the agent was trained with a pole of 0.36 m, the cart has one of 0.50 m"
    assert other_pole([MEDIUM], pole_of_length(0.5, MEDIUM), emulated=False) == line


def test_the_pole_that_shakes_a_cart_most_has_the_longest_lever() -> None:
    """Not the largest mass times length: a heavy pole moves the common centre of mass less far."""
    poles = {"short": (0.3, 0.12), "long": (0.1, 0.3)}
    choices = {
        name: {"pole_mass": mass, "pole_com": com, "pole_inertia": 1e-3}
        for name, (mass, com) in poles.items()
    }
    numbers = with_shaking_pole(choice("cart/laboratorio"), PoleSettings(choices=choices))
    assert (numbers["pole_mass"], numbers["pole_com"]) == poles["long"]


def test_the_words_for_a_cart_keep_its_line_speed_and_its_pole() -> None:
    assert plant_words(SerialSettings(port="COM3")) == "plant=serial plant.port=COM3"
    assert plant_words(SerialSettings(port="COM3", policy="onboard")) == "plant=serial plant.port=COM3"
    other = SerialSettings(port="COM3", baud=115200, pole_length=0.66)
    assert plant_words(other) == "plant=serial plant.port=COM3 plant.baud=115200 plant.pole_length=0.66"


@pytest.mark.parametrize(
    "words",
    [
        "plant=emulated",
        "plant=emulated emulator=large emulator.cart_viscous=2.0",
        "plant=emulated emulator=stand_in plant.rehome=always",
        "plant=emulated emulator=laboratorio emulator.cart=null",
        "plant=emulated emulator=large 'emulator.cart={cart_mass:0.5,cart_viscous:2e-05}'",
        "plant=emulated emulator.clock=real 'emulator.force_curve=[0.0,0.02,-0.9]'",
        "plant=serial plant.port=COM3 plant.clear_faults=2",
    ],
)
def test_the_words_for_a_cart_and_for_the_cart_of_a_run_choose_the_same_cart(
    words: str, tmp_path: Path
) -> None:
    given = {key: value for key, _, value in (word.partition("=") for word in shlex.split(words))}
    config = load_settings(IdentifyConfig, shlex.split(words))
    found = plant_words(config.plant, config.emulator)
    assert load_settings(IdentifyConfig, shlex.split(found)).plant == config.plant
    assert load_settings(IdentifyConfig, shlex.split(found)).emulator == config.emulator
    assert {word.partition("=")[0] for word in shlex.split(found)} == given.keys()
    identified, imported = tmp_path / "a", tmp_path / "b"
    write_config(identified, "identify", config.model_dump(mode="json", by_alias=True))
    write_config(imported, "identify", {"seed": 0, "from": str(identified)})
    assert words_of_run(imported) == found
    assert words_of_run(tmp_path) is None


def test_the_words_for_a_cart_have_no_knock_and_no_journal(tmp_path: Path) -> None:
    emulator = EmulatorSettings(knock=2.0, journal=tmp_path / "journal", cart_viscous=2.0)
    assert (
        plant_words(EmulatedSettings(kind="emulated"), emulator) == "plant=emulated emulator.cart_viscous=2.0"
    )


@pytest.mark.parametrize("cart", [{}, choice("cart/stepper"), {"track_span": 0.7}])
def test_the_emulated_cart_that_is_advised_for_its_pole_fits_every_rig(cart: dict[str, float]) -> None:
    known, plant = [PoleSettings(**choice("pole/rod_03"))], EmulatedSettings(kind="emulated")
    words = emulated_words(known)
    assert words == plant_words(plant, EmulatorSettings(), known) == "plant=emulated emulator=rod_03"
    given = plant_words(plant, EmulatorSettings(cart="laboratorio"), known)
    assert given == "plant=emulated emulator=rod_03 emulator.cart=laboratorio"
    emulated = load_settings(IdentifyConfig, shlex.split(words)).emulator.of_cart(cart)
    assert emulated.cart_viscous == EmulatorSettings().of_cart(cart).cart_viscous
    chosen = ["emulator=rod_03", "emulator.cart=laboratorio"]
    with pytest.raises(ConfigError, match="give the file of that cart"):
        load_settings(IdentifyConfig, chosen).emulator.of_cart(cart)
