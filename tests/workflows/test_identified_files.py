"""What an identification writes: each number exactly, with its unit, and errors where the truth is known."""

import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.identification.fit import Fit
from cartpole_rl.identification.identify import Candidate, Identification, PredictionError
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.unknowns import WEIGHED, unknowns_of
from cartpole_rl.physics.friction import CART_FRICTIONS, COULOMB, stribeck_force
from cartpole_rl.physics.models import Models
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.rig.parameters import POSITIVE, Parameter, factor
from cartpole_rl.run_folder import write_config
from cartpole_rl.workflows.build import identified_note
from cartpole_rl.workflows.config import EvaluateConfig, IdentifyConfig, TrainConfig, load_settings
from cartpole_rl.workflows.identify import errors, friction_choice, write_choices

HARDWARE = nominal_hardware().model_copy(update={"track_span": 0.5, "pole_counts_per_turn": 2400})


def write(models: Models, nominal: dict[str, float], folder: Path) -> dict[str, float]:
    """Write the files of a cart whose numbers have many digits; return the numbers."""
    unknowns = unknowns_of(models, WEIGHED)
    size = len(unknowns)
    fit = Fit(unknowns, np.full(size, 0.123456789), np.eye(size), nominal, np.ones(2), np.zeros(2), 1.0)
    dynamics = Dynamics.of(fit.parameters, models, 0.02, 4)
    error = PredictionError(1e-3, 0.01)
    found = Identification(fit, dynamics, [Candidate(fit, dynamics, error)], [], [], error, [])
    write_choices(found, fit.draw(20, np.random.default_rng(0)), 10, folder, HARDWARE)
    of_cart = {name: value for name, value in fit.parameters.items() if name not in Pole.model_fields}
    return {**of_cart, **HARDWARE.model_dump()}


def test_the_cart_has_every_number_and_the_rig(nominal: dict[str, float], tmp_path: Path) -> None:
    expected = write(Models(), nominal, tmp_path)
    assert yaml.safe_load((tmp_path / "cart.yaml").read_text()) == expected
    assert not (tmp_path / "cart_friction.yaml").exists()
    assert friction_choice(Models().cart_friction, tmp_path) == "cart_friction=sigmoid"


@pytest.mark.usefixtures("own_extensions")
def test_a_law_of_a_user_has_a_file_with_the_parameters_that_it_brings(
    nominal: dict[str, float], tmp_path: Path
) -> None:
    """Not the cart's: only a process that has imported the law knows them."""
    slip = Parameter("test_slip", "m/s", POSITIVE, 0.005, factor(1.0), "speed of 76 % of the friction")
    CART_FRICTIONS.add("test:law", stribeck_force, reads=(*COULOMB, slip))
    models = Models.of(cart_friction="test:law")
    numbers = write(models, nominal, tmp_path)
    choice = yaml.safe_load((tmp_path / "cart_friction.yaml").read_text())
    assert choice == {"model": "test:law", "parameters": {"test_slip": numbers.pop("test_slip")}}
    assert yaml.safe_load((tmp_path / "cart.yaml").read_text()) == numbers
    assert shlex.split(friction_choice(models.cart_friction, Path("my id"))) == [
        'cart_friction="my id/cart_friction.yaml"'
    ]


@pytest.mark.parametrize(
    ("rig", "plant", "file"),
    [
        ({"pole_counts_per_turn": 2400}, "emulated", "<the cart= of cartpole-identify>"),
        (choice("cart/laboratorio"), "emulated", "laboratorio"),
        ({"pole_counts_per_turn": 2400}, "serial", None),
        ({"pole_counts_per_turn": 2400}, None, None),
        ({}, "emulated", None),
    ],
)
def test_that_an_emulated_cart_is_made_from_identified_numbers_is_noted(
    rig: dict[str, float], plant: str | None, file: str | None, nominal: dict[str, float], tmp_path: Path
) -> None:
    """Not on ip02's rig, where it has numbers of its own, nor if a real cart was identified."""
    write(Models(), nominal, tmp_path)
    if plant:
        port = {"plant.port": "auto"} if plant == "serial" else {}
        config = load_settings(IdentifyConfig, {"plant": plant, **port})
        write_config(tmp_path, "identify", config.model_dump(mode="json", by_alias=True))
    files = {name: tmp_path / f"{name}.yaml" for name in ("pole", "randomization")}
    cart = yaml.safe_load((tmp_path / "cart.yaml").read_text()) | nominal_hardware().model_dump() | rig
    training = load_settings(TrainConfig, {"cart": cart, **files})

    def note(**given: str) -> str | None:
        return identified_note(training, load_settings(EvaluateConfig, {"run": "any", **given}))

    assert (note(plant="emulated") or "").partition("give emulator.cart=")[2] == (file or "")
    assert note(plant="simulated") is note(plant="emulated", emulator="sensorsini") is None


TRUTH = EmulatorSettings(
    cart_coulomb_left=0.4, cart_coulomb_right=0.6, force_curve=(0.0, 0.02, -1.0), force_asymmetry=0.0
)
EXACT = {
    **TRUTH.model_dump(include={"cart_mass", "pole_mass", "pole_com", "cart_viscous", "pole_viscous"}),
    "cart_coulomb": 0.5,
    "force_quadratic": 0.0,
    "force_linear": 0.02,
    "force_offset": -1.0,
    "force_asymmetry": 0.0,
}


def test_an_error_is_relative_to_the_truth_of_what_was_estimated() -> None:
    assert set(errors(EXACT, TRUTH)["errors"].values()) == {0.0}
    other = {**EXACT, "cart_viscous": 0.0, "cart_mass": 1.5 * TRUTH.cart_mass}
    found = errors(other, TRUTH, {"cart_viscous"})["errors"]
    assert "cart_viscous" not in found
    assert found["cart_mass"] == pytest.approx(0.5)
    assert found["median"] == 0
    assert errors(EXACT, None) == {}
