"""Prediction is the simulator's, and a fit finds the cart that was simulated."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from shaken import MOTORS, shaken

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.identify import warnings
from cartpole_rl.identification.prediction import errors_at, predict, root_mean_square
from cartpole_rl.identification.rollout import Dynamics, rollout
from cartpole_rl.identification.unknowns import WEIGHED, limits, parameters_at, unknowns_of
from cartpole_rl.identification.windows import (
    HELD_OUT_LEAD,
    WINDOW,
    cut_windows,
    held_out_windows,
    history_periods,
    hold_out,
)
from cartpole_rl.physics.friction import CART_FRICTIONS, COULOMB, coulomb_force
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.rig.parameters import POSITIVE, Parameter, factor
from cartpole_rl.tasks.episode import Episode

PERIOD = 0.02
STEP = Models.of(cart_friction="step")
TRUTH = {
    "cart_viscous": 1.2,
    "cart_coulomb": 0.35,
    "cart_coulomb_asymmetry": 0.1,
    "pole_viscous": 6e-4,
    "force_asymmetry": -0.08,
    "latency": 0.013,
    "motor_time_constant": 0.006,
    "track_tilt": 0.004,
    "angle_offset": 0.008,
    "track_half_length": 2.0,
}

REACHED = np.where(np.arange(51)[:, None, None] < [51] * 16 + [30] * 2, 1.0, np.nan)  # two of 18 end early
ERROR = REACHED * np.array([0.02, np.radians(3)])[:, None]  # [51, 2, 18] m, rad

MakePlant = Callable[..., SimulatedPlant]
MakeEnvironment = Callable[..., CartPoleEnv]


@pytest.fixture(scope="module")
def episodes(make_plant: MakePlant, make_environment: MakeEnvironment) -> list[Episode]:
    """Four times ten seconds of a cart that is shaken: each motor value is held for 0.2 s."""
    return shaken(make_environment(make_plant(4, cart=TRUTH, models=STEP), MOTORS))


def test_the_true_cart_predicts_every_count(episodes: list[Episode], nominal: dict[str, float]) -> None:
    """From the true initial state at rest, to the rounding of the encoders."""
    first = episodes[0]
    motors = np.concatenate((np.zeros(history_periods(PERIOD)), first.motor[:50]))
    table = cart_column({**nominal, **TRUTH})
    motion = torch.tensor([[0.0], [0.0], [np.pi], [0.0]], dtype=torch.float64)
    measured = rollout(table, motion, torch.from_numpy(motors).unsqueeze(1), STEP, PERIOD, 4)[..., 0]
    count = np.array([first.encoders.metres, first.encoders.radians])
    assert np.abs(measured.numpy() / count - first.counts[:51]).max() < 0.6


def test_a_fit_finds_another_pole(
    make_plant: MakePlant,
    make_environment: MakeEnvironment,
    both_poles: PoleSettings,
    nominal: dict[str, float],
) -> None:
    large = PoleSettings(choices={"large": (both_poles.choices or {})["large"]})
    plant = make_plant(2, poles=large, models=STEP, cart={"track_half_length": 2.0})
    recorded = shaken(make_environment(plant, MOTORS, time_limit=300), hold=1)
    found = fit_cart(cut_windows(recorded, PERIOD, most=16), nominal, STEP, PERIOD).parameters
    assert found["pole_com"] == pytest.approx(large.nominal.pole_com, rel=0.05)


def test_a_friction_that_is_0_in_the_file_is_found(
    episodes: list[Episode], nominal: dict[str, float]
) -> None:
    smooth = {**nominal, "cart_viscous": 0.0, "cart_coulomb": 0.0}
    found = fit_cart(cut_windows(episodes, PERIOD, most=10), smooth, STEP, PERIOD, known=WEIGHED).parameters
    assert found["cart_viscous"] == pytest.approx(TRUTH["cart_viscous"], rel=0.1)
    assert found["cart_coulomb"] == pytest.approx(TRUTH["cart_coulomb"], rel=0.1)


def test_counts_that_jump_are_no_carts(episodes: list[Episode], nominal: dict[str, float]) -> None:
    """As with a loose encoder plug."""
    random = np.random.default_rng(0)
    jumping = [
        dataclasses.replace(each, counts=each.counts + random.integers(-(10**6), 10**6, each.counts.shape))
        for each in episodes
    ]
    with pytest.raises(RecordingError, match="their counts jump: check the encoders") as raised:
        fit_cart(cut_windows(jumping, PERIOD, most=10), nominal, STEP, PERIOD).draw(5, random)
    assert "\n" not in str(raised.value)


def test_draws_are_physically_possible(nominal: dict[str, float]) -> None:
    unknowns = unknowns_of(STEP)
    point, covariance = np.zeros(len(unknowns)), np.eye(len(unknowns))
    fit = Fit(unknowns, point, covariance, nominal, np.zeros(2), np.zeros(2), 1.0)
    drawn = dict(
        zip(CartParameters.names(), fit.draw(500, np.random.default_rng(0), widen=20.0), strict=True)
    )
    assert (drawn["latency"] >= 0).all()
    assert (drawn["cart_mass"] > 0).all()
    assert drawn["cart_viscous"].std() > 0


@pytest.mark.usefixtures("own_extensions")
def test_a_law_of_a_user_is_fitted_with_its_own_parameter(
    episodes: list[Episode], nominal: dict[str, float]
) -> None:
    slip = Parameter("test_slip", "m/s", POSITIVE, 0.005, factor(1.0), "speed of 76 % of the friction")

    @CART_FRICTIONS.register("test_tanh", reads=(*COULOMB, slip))
    def tanh_force(x_dot: torch.Tensor, cart: CartParameters) -> torch.Tensor:
        return coulomb_force(x_dot, cart) * (x_dot / cart.test_slip).tanh()

    windows, tanh = cut_windows(episodes, PERIOD, most=20), Models.of(cart_friction="test_tanh")
    fit = fit_cart(windows, nominal, tanh, PERIOD, iterations=4)
    assert "test_slip" in [unknown.name for unknown in fit.unknowns]
    assert fit.parameters["test_slip"] != slip.default
    others = [unknown.name for unknown in unknowns_of(STEP)]
    assert "test_slip" not in others
    assert others[-2:] == ["track_tilt", "angle_offset"]


def test_limits_match_the_parameter_bounds(nominal: dict[str, float]) -> None:
    unknowns = unknowns_of(STEP)
    low, _ = limits(unknowns, nominal)
    at_low = np.where(np.isfinite(low), low, 0.0)[:, None]
    cart = CartParameters(parameters_at(at_low, unknowns, nominal))
    assert cart.latency.item() == pytest.approx(0, abs=1e-12)
    assert cart.motor_time_constant.item() == pytest.approx(0, abs=1e-12)
    assert "cart_stiction_ratio" not in {unknown.name for unknown in unknowns}


class TestWindows:
    def test_lost_frames_are_left_out(self, episodes: list[Episode]) -> None:
        whole = cut_windows(episodes[:1], PERIOD)
        gap = episodes[0].time.copy()
        gap[30:] += PERIOD
        broken = Episode(**{**vars(episodes[0]), "time": gap})
        assert cut_windows([broken], PERIOD).number < whole.number

    def test_too_short_recordings_are_refused(self, episodes: list[Episode]) -> None:
        with pytest.raises(RecordingError, match=r"no recording lasts 12 s: record longer$"):
            cut_windows(episodes, PERIOD, seconds=12.0)

    def test_the_period_of_one_that_holds_no_window_is_not_judged(self, episodes: list[Episode]) -> None:
        late = episodes[0].part(0, 3)
        late = Episode(**{**vars(late), "time": 2 * late.time})
        windows = cut_windows([late, episodes[0]], PERIOD)
        assert windows.number == cut_windows(episodes[:1], PERIOD).number

    def test_their_length_is_in_seconds(
        self, make_plant: MakePlant, make_environment: MakeEnvironment, nominal: dict[str, float]
    ) -> None:
        """At a control period of 5 ms, motor values 50 ms ago still act on the cart."""
        period, latency = 0.005, 0.05
        cart = {**TRUTH, "latency": latency}
        plant = make_plant(2, cart=cart, models=STEP, period=period, substeps=4)
        recorded = shaken(make_environment(plant, MOTORS, time_limit=250), hold=40)
        windows = cut_windows(recorded, period, most=4)
        assert windows.periods * period == pytest.approx(WINDOW)
        assert len(windows.motors) == windows.periods + history_periods(period)
        assert history_periods(period) * period >= latency
        dynamics = Dynamics.of({**nominal, **cart}, STEP, period, 4)
        assert np.abs(predict(windows._replace(lead=20), dynamics).error[-1, 0]).max() < 1e-3


def test_rms_is_of_what_is_known() -> None:
    errors = np.array([[3.0, 1.0, np.nan], [4.0, np.nan, np.nan]]).T
    np.testing.assert_allclose(root_mean_square(errors), [np.sqrt(12.5), 1.0, np.nan])


def test_errors_count_the_windows_that_reach_a_time() -> None:
    early, late = errors_at(ERROR, (0.1, 1.0, 7.0), 0.02)  # none at 7 s
    assert (early["after_s"], early["windows"]) == (0.1, 18)
    assert (late["after_s"], late["windows"]) == (1.0, 16)
    assert [each["after_s"] for each in errors_at(ERROR, (0.1, 1.0), 0.03)] == [0.09, 0.99]
    for line in (early, late):
        assert line["rms_x_mm"] == pytest.approx(20)
        assert line["median_theta_deg"] == pytest.approx(3)
        assert "rms_spread_x_mm" not in line


def test_spreads_stand_beside_the_errors() -> None:
    spread = np.full_like(ERROR, 0.015)
    spread[:, :, :9] = 0.005  # too small for the cart's error, within two for the rest
    (line,) = errors_at(ERROR, [0.1], 0.02, spread)
    assert line["within_x_mm"] == pytest.approx(0.5)
    assert line["median_spread_x_mm"] == pytest.approx(10)
    assert line["rms_spread_x_mm"] == pytest.approx(np.sqrt(125))


def numbered(periods: int, period: float) -> Episode:
    """Motion whose counts and motor values are the numbers of their rows."""
    rows = np.arange(periods + 1)
    zeros, steps = np.zeros(periods + 1), np.zeros(periods)
    counts = np.stack((rows, rows), 1)
    motor = rows[:-1]
    return Episode(period * rows, zeros, zeros, zeros, zeros, counts, motor, steps, steps, steps, "time")


@pytest.mark.parametrize("period", [0.005, 0.02, 0.1])
def test_windows_have_their_lead_and_history(period: float) -> None:
    windows = held_out_windows([numbered(round(8 / period), period)], period, 1.0)
    assert (windows.periods - windows.lead) * period == pytest.approx(1.0)
    assert windows.lead * period >= HELD_OUT_LEAD
    counts = windows.positions[0, 0] / windows.resolution[0]
    assert windows.motors[history_periods(period)] == pytest.approx(counts)
    assert windows.number > 3


def test_too_short_is_named() -> None:
    with pytest.raises(RecordingError, match=r"have no 1\.44 s without a lost frame"):
        held_out_windows([numbered(60, 0.02)], 0.02, 1.0)


def test_every_fifth_is_held_out_or_the_last_fifth_of_a_few() -> None:
    whole = [numbered(100 + number, 0.02) for number in range(10)]
    learned, held_out = hold_out(whole)
    assert [each.steps for each in held_out] == [102, 107]
    assert len(learned) == 8
    learned, held_out = hold_out(whole[:1])
    assert (learned[0].steps, held_out[0].steps) == (80, 20)
    assert held_out[0].motor[0] == learned[0].motor[-1] + 1


@pytest.mark.parametrize(("point", "said"), [(0.2, "hardly show cart_mass"), (9.0, "cart_mass = ")])
def test_a_parameter_is_unusual_or_not_shown_but_not_both(
    nominal: dict[str, float], point: float, said: str
) -> None:
    (mass,) = (each for each in unknowns_of(STEP) if each.name == "cart_mass")
    fit = Fit([mass], np.array([point]), np.array([[0.9]]), nominal, np.zeros(2), np.zeros(2), 1.0)
    (warning,) = warnings(fit, nominal_encoders())
    assert said in warning
