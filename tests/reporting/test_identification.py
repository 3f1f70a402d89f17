"""The page, the tables and the figures of an identification show what they were given."""

import dataclasses

import numpy as np
import pytest
import torch

from cartpole_rl.identification.fit import Fit
from cartpole_rl.identification.identify import Candidate, Identification, PredictionError, Quantity
from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.reporting.identification import (
    CAPTIONS,
    experiments_figure,
    force_curve,
    friction_curve,
    identification_page,
    quantities_table,
    spectrum_figure,
    unexplained,
    unexplained_figure,
)
from cartpole_rl.tasks.episode import Episode

QUANTITIES = [
    Quantity("latency", "latency", "ms", 12.0, 11.0, 13.0, 5.0),
    Quantity("viscous", "viscous friction", "1/s", 1.2, 1.1, 1.3, 0.6),
]
FIT = Fit([], np.empty(0), np.empty((0, 0)), {}, np.ones(2), np.zeros(2), 1.0)


def candidate(friction: Law, x: float, theta: float) -> Candidate:
    dynamics = Dynamics(torch.empty(0, 1), Models(cart_friction=friction), 0.02, 4)
    return Candidate(FIT, dynamics, PredictionError(x, theta))


def found(warnings: list[str]) -> Identification:
    best = candidate(CART_FRICTIONS.find("step"), 1e-3, 0.01)
    candidates = [best, candidate(CART_FRICTIONS.find("linear"), 2e-3, 0.02)]
    return Identification(FIT, best.dynamics, candidates, [], [], best.error, warnings)


def test_the_table_has_values_with_intervals_and_units() -> None:
    rows = [line.split("  ") for line in quantities_table(QUANTITIES).splitlines()[2:]]
    assert [[cell.strip() for cell in row if cell] for row in rows] == [
        ["latency", "12.0 ± 1.0", "ms"],
        ["viscous friction", "1.20 ± 0.10", "1/s"],
    ]


def test_the_experiments_of_a_part_of_a_recording_are_drawn(swing_up: Episode) -> None:
    """The held-out end of a short recording: its time does not begin at 0."""
    late = dataclasses.replace(swing_up, time=swing_up.time + 48)
    replayed = Replayed(late, *(np.zeros((0, 1)) for _ in range(5)))
    figure = experiments_figure({"end": replayed})
    assert figure.axes[0].get_xlim()[0] == pytest.approx(48, abs=1)


def test_the_page_shows_all_results(swing_up: Episode) -> None:
    odd = dataclasses.replace(swing_up, ended_by="<fault>")
    recordings = {"ramps": swing_up, "<my> recording": odd}
    text = identification_page(found(["check a"]), QUANTITIES, recordings, "train x=1")
    for part in ("ramps", "where the cart breaks away", "&lt;my&gt; recording", "&lt;fault&gt;"):
        assert part in text
    for part in ("12.0 ± 1.0", "0.600", "1/s", "2.00", "check a", "train x=1"):
        assert part in text
    assert "1.00 mm and 0.57 deg" in text
    for name, caption in CAPTIONS.items():
        assert f'src="figures/{name}.png" alt="{caption}"' in text


NAMES = CartParameters.names()


@pytest.fixture(scope="module")
def prior(nominal: dict[str, float]) -> dict[str, float]:
    return {**nominal, "cart_coulomb_asymmetry": 0.0}


def samples(prior: dict[str, float], **changes: tuple[float, ...]) -> np.ndarray:
    """Carts [P, N] that differ in `changes` alone."""
    count = len(next(iter(changes.values())))
    return np.array([changes.get(name, (prior[name],) * count) for name in NAMES])


def test_friction_over_velocity(prior: dict[str, float]) -> None:
    identified = {**prior, "cart_coulomb": 0.4, "cart_viscous": 2.0}
    carts = samples(prior, cart_viscous=(1.0, 3.0))
    curve = friction_curve(identified, carts, prior, CART_FRICTIONS.find("step"))
    fast = int(np.abs(curve.at - 0.5).argmin())
    assert curve.identified[fast] == pytest.approx(0.4 + 2.0 * 0.5)
    assert curve.identified[-1] == pytest.approx(-curve.identified[0])
    assert np.diff(curve.samples[fast]) == pytest.approx(2.0 * 0.5)
    assert curve.prior[fast] == pytest.approx(prior["cart_coulomb"] + prior["cart_viscous"] * 0.5)


@pytest.mark.parametrize("sign", [-1, 1])
def test_force_over_motor_value(prior: dict[str, float], sign: int) -> None:
    symmetric = {**prior, "force_asymmetry": 0.0}
    identified = {**symmetric, "force_linear": 0.03}
    carts = samples(symmetric, force_linear=(0.03,))
    curve = force_curve(identified, carts, symmetric, ACTUATORS.find("force_curve"))
    (at,) = np.flatnonzero(curve.at == sign * 200)
    more = sign * 200 * (0.03 - prior["force_linear"])
    assert curve.identified[at] - curve.prior[at] == pytest.approx(more)
    assert curve.samples[at, 0] == pytest.approx(curve.identified[at])


def test_the_spectrum_is_that_of_the_covariance() -> None:
    figure = spectrum_figure(np.diag([0.25, 0.01]), ["latency", "cart_mass"])
    bars, weights = figure.axes
    assert [bar.get_width() for bar in bars.patches] == pytest.approx([0.1, 0.5])
    np.testing.assert_allclose(weights.images[0].get_array(), [[0, 1], [1, 0]])
    assert [label.get_text() for label in weights.get_xticklabels()] == ["latency", "cart_mass"]


def test_what_is_not_explained_is_the_difference_of_accelerations(swing_up: Episode) -> None:
    period, rows = 0.02, 51
    time = swing_up.time[0] + period * np.arange(rows)
    error = -0.5 * 1.5 * (time - time[0]) ** 2  # the measured cart gains 1.5 m/s^2 on the simulated one
    measured = swing_up.x[:rows]
    nothing = np.zeros((1, rows))
    replayed = Replayed(swing_up, time[None], (measured + error)[None], nothing, error[None], nothing)
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, len(swing_up.time)) * period
    late = dataclasses.replace(swing_up, time=swing_up.time + jitter)
    np.testing.assert_array_equal(replayed._replace(episode=late).rows(), [np.arange(rows)])
    found = unexplained([replayed], latency=0.0)
    assert found.acceleration == pytest.approx(np.full(rows - 2, 1.5))
    assert found.position == pytest.approx(measured[1:-1])
    assert found.speed == pytest.approx((measured[2:] - measured[:-2]) / (2 * period))
    motor = swing_up.motor.astype(float)
    assert found.motor == pytest.approx((motor[: rows - 2] + motor[1 : rows - 1]) / 2)
    panels = unexplained_figure(found).axes
    assert [axes.get_xlabel() for axes in panels] == ["position (cm)", "speed (m/s)", "motor value"]
    for axes in panels:
        (line, _) = axes.lines
        assert line.get_ydata() == pytest.approx(np.full(len(line.get_ydata()), 1.5))
