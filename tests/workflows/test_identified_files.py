"""The files of an identification give each number exactly, with the unit that conf/ gives it."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from cartpole_rl.choices import conf_folder
from cartpole_rl.identification.fit import Fit
from cartpole_rl.identification.identify import Candidate, Identification, PredictionError
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.unknowns import WEIGHED, unknowns_of
from cartpole_rl.physics.models import Models
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.workflows.identified_files import write_choices


@pytest.fixture
def folder(ip02: dict[str, float], medium: PoleSettings, tmp_path: Path) -> Path:
    """The files of a cart whose numbers have many digits."""
    unknowns, nominal = unknowns_of(Models(), WEIGHED), {**ip02, **medium.nominal.model_dump()}
    size = len(unknowns)
    fit = Fit(unknowns, np.full(size, 0.123456789), np.eye(size), nominal, np.ones(2), np.zeros(2), 1.0, 1)
    dynamics = Dynamics.of(fit.parameters, Models(), 0.02, 4)
    error = PredictionError(1e-3, 0.01)
    found = Identification(fit, dynamics, [Candidate(fit, dynamics, error)], [], error, [])
    write_choices(found, fit.draw(10, np.random.default_rng(0)), tmp_path)
    expected = {name: value for name, value in fit.parameters.items() if name not in Pole.model_fields}
    assert yaml.safe_load((tmp_path / "cart.yaml").read_text()) == expected
    return tmp_path


def test_the_units_are_those_of_the_nominal_cart(folder: Path) -> None:
    line = re.compile(r"^(\w+): +\S+ +# ([^,:;}\n]+)", re.MULTILINE)
    written = dict(line.findall((folder / "cart.yaml").read_text()))
    nominal = {
        name: unit.strip() for name, unit in line.findall((conf_folder() / "cart/ip02.yaml").read_text())
    }
    assert written.keys() == nominal.keys()
    for name in written.keys() - {"deadband_left", "deadband_right", "latency"}:  # there in words
        assert written[name] == nominal[name], name
    assert written["deadband_left"] == written["deadband_right"] == "motor value"
    assert written["latency"] == "s"


def test_pole_and_randomization_name_their_units(folder: Path) -> None:
    assert (
        (folder / "pole.yaml")
        .read_text()
        .startswith("# pole_mass in kg, pole_com in m, pole_inertia in kg m^2.\n")
    )
    assert "# Absolute ranges are in s (latency_jitter).\n" in (folder / "randomization.yaml").read_text()
