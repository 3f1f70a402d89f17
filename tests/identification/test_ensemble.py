"""A residual learned from recordings: it finds what the physics lacks, and is zero if nothing does."""

from collections.abc import Callable, Mapping
from functools import cache, partial

import numpy as np
import pytest
import torch
from courses import scattered
from shaken import MOTORS, shaken

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError, RecordingError
from cartpole_rl.identification.ensemble import Ensemble, within_spreads
from cartpole_rl.identification.matching import match_initial_states
from cartpole_rl.identification.prediction import errors_at, predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.settings import EnsembleSettings
from cartpole_rl.identification.windows import Windows, cut_windows, history_periods
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.residual import PLACES, Residual
from cartpole_rl.plants.learned import LearnedModel, LearnedPlant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer

PERIOD, SUBSTEPS = 0.02, 1
STEP = Models.of(cart_friction="step")
START = scattered(position_spread=0.2, angle_spread=0.5)
TRACK = {"track_half_length": 2.0}
RIPPLE = 0.6  # N
PITCH = 0.08  # m
LEAD = 10  # periods
SPAN = 0.814  # m between the stops
SETTINGS = EnsembleSettings(
    members=2,
    hidden=6,
    updates=40,
    learning_rate=0.05,
    refresh=10,
    validation=0.2,
    output_penalty=3.0,
    table_penalty=0.1,
)

MakeEnvironment = Callable[..., CartPoleEnv]
Record = Callable[[bool], tuple[Windows, Windows, Windows]]


def rippled() -> Residual:
    """A residual of one member that adds only a force ripple along the track."""
    zeros = Residual.untrained(1, 6, torch.Generator().manual_seed(0), PERIOD, 4.0, SPAN)
    places = zeros.spacing * (torch.arange(PLACES) - PLACES // 2)
    forces = RIPPLE * torch.sin(2 * torch.pi * places / PITCH)
    return zeros._replace(places=(forces / zeros.units[0]).unsqueeze(0))


@pytest.fixture(scope="module")
def parameters(nominal: dict[str, float]) -> dict[str, float]:
    return {**nominal, **TRACK}


@pytest.fixture(scope="module")
def dynamics(parameters: dict[str, float]) -> Dynamics:
    return Dynamics.of(parameters, STEP, PERIOD, SUBSTEPS)


@pytest.fixture(scope="module")
def record(
    ip02: dict[str, float],
    medium: PoleSettings,
    parameters: Mapping[str, float],
    make_environment: MakeEnvironment,
) -> Record:
    """Windows to learn from, longer ones held out and of the same, of a cart whose track ripples, or not."""

    @cache
    def build(ripples: bool) -> tuple[Windows, Windows, Windows]:
        randomizer = Randomizer({**ip02, **TRACK}, medium, {})
        if ripples:
            model = LearnedModel(parameters, STEP, PERIOD, SUBSTEPS, rippled())
            plant: SimulatedPlant = LearnedPlant(8, model, randomizer, START, seed=1)
        else:
            plant = SimulatedPlant(8, randomizer, START, STEP, substeps=SUBSTEPS, seed=1)
        recorded = shaken(make_environment(plant, MOTORS, time_limit=300))
        longer, held_out = (
            cut_windows(part, PERIOD, LEAD * PERIOD + 1.0, most=60)._replace(lead=LEAD)
            for part in (recorded[:6], recorded[6:])
        )
        return cut_windows(recorded[:6], PERIOD, most=40), held_out, longer

    return build


def few(windows: Windows, number: int) -> Windows:
    return windows._replace(positions=windows.positions[..., :number], motors=windows.motors[:, :number])


def judged(
    windows: Windows, dynamics: Dynamics, residual: Residual | None, moment: float = 0.5
) -> dict[str, float]:
    error, spread = predict(windows, dynamics, residual)[1:]
    (errors,) = errors_at(error, [moment], PERIOD, spread)
    return errors


def test_an_effect_that_the_physics_lacks_is_learned(
    record: Record, dynamics: Dynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cartpole_rl.identification.ensemble.HALVINGS", 1)  # each one predicts all windows
    windows, held_out, longer = record(True)
    ensemble = Ensemble(windows, dynamics, np.array([4.5e-4, 4.6e-3]), SETTINGS, 0, SPAN)
    ensemble.learn()
    residual = ensemble.calibrate(longer)
    physics, learned = (judged(held_out, dynamics, each) for each in (None, residual))
    assert physics["rms_x_mm"] > 3  # so that there is something to be learned
    assert learned["rms_x_mm"] < 0.6 * physics["rms_x_mm"]
    assert learned["rms_spread_x_mm"] > 0
    assert residual.widening > 1
    as_learned = judged(held_out, dynamics, residual.not_widened())
    assert as_learned["within_x_mm"] < learned["within_x_mm"]
    assert as_learned["rms_x_mm"] == learned["rms_x_mm"]
    ends = within_spreads(longer, dynamics, residual.not_widened())[-1].mean((1, 2))
    assert ensemble.covered(1.0, longer) <= ends.min() < ensemble.covered(float(residual.widening), longer)
    assert ensemble.allowed == ensemble.covered(float(residual.widening), longer)
    turned = held_out.positions.copy()
    turned[held_out.lead + 1 :, 1] += np.pi  # so that the members' errors lie on both sides of half a turn
    after_half_a_turn = predict(held_out._replace(positions=turned), dynamics, residual).spread
    assert after_half_a_turn == pytest.approx(predict(held_out, dynamics, residual).spread, nan_ok=True)
    assert learned["within_x_mm"] > 0.6
    assert physics["rms_spread_x_mm"] == 0
    assert min(ensemble.history[0]) > max(min(each) for each in zip(*ensemble.history, strict=True))
    near = slice(PLACES // 2 - 40, PLACES // 2 + 41)  # 16 cm to each side, where the carts are most
    mean = residual.places.mean(0)[near].numpy()
    assert np.corrcoef(mean, rippled().places[0, near].numpy())[0, 1] > 0.5


@pytest.mark.parametrize("period", [0.005, 0.01, 0.02, 0.05])
def test_a_residual_of_zeros_predicts_the_same(parameters: Mapping[str, float], period: float) -> None:
    late = {**parameters, "motor_time_constant": 0.02, "latency": 0.012}
    dynamics = Dynamics.of(late, STEP, period, 4)
    nothing = Residual.untrained(2, 6, torch.Generator().manual_seed(0), period, 4.0, SPAN).as_type(
        torch.float64
    )
    random = torch.Generator().manual_seed(1)
    motors = 400 * torch.rand(history_periods(period) + 20, 3, generator=random, dtype=torch.float64) - 200
    motion = torch.zeros(4, 1, 3, dtype=torch.float64)
    plain = dynamics.positions(motion, motors)
    both = dynamics.positions(motion.repeat(1, 2, 1), motors, nothing)
    assert torch.allclose(both, plain.expand_as(both), atol=1e-12)


def test_complete_physics_gets_no_residual(record: Record, dynamics: Dynamics) -> None:
    windows, held_out, longer = record(False)
    settings = SETTINGS.model_copy(update={"updates": 12, "refresh": 6})
    ensemble = Ensemble(windows, dynamics, np.array([2.3e-5, 6e-4]), settings, 0, SPAN)
    ensemble.learn()
    residual = ensemble.calibrate(longer)
    assert residual.widening == 1
    physics, learned = (judged(held_out, dynamics, each) for each in (None, residual))
    for key in ("rms_x_mm", "median_x_mm", "rms_theta_deg", "median_theta_deg"):
        assert learned[key] < 1.2 * physics[key]


def test_the_true_model_predicts_held_out_motion(record: Record, dynamics: Dynamics) -> None:
    _, held_out, _ = record(True)
    true, physics = (judged(held_out, dynamics, each) for each in (rippled().as_type(torch.float64), None))
    assert true["rms_x_mm"] < 0.1 * physics["rms_x_mm"]


def test_nothing_after_the_lead_affects_an_initial_state(record: Record, dynamics: Dynamics) -> None:
    _, windows, _ = record(False)
    changed = windows.positions.copy()
    changed[LEAD + 1 :] += 1
    before = predict(windows, dynamics).error
    after = predict(windows._replace(positions=changed), dynamics).error
    assert np.array_equal(before[0], after[0])


def test_initial_states_are_found(record: Record, dynamics: Dynamics) -> None:
    """The estimates from encoder counts are the true initial states."""
    windows, _, _ = record(False)
    positions, motors = torch.from_numpy(windows.positions), torch.from_numpy(windows.motors)
    unscaled = torch.from_numpy(windows.resolution)
    match = partial(match_initial_states, dynamics, motors=motors, rounds=4, scale=unscaled)
    true = match(positions).motion
    again = match(dynamics.positions(true, motors).squeeze(2))
    assert (again.motion - true).abs().squeeze(1)[1].median() < 1e-3  # m/s
    assert (again.motion - true).abs().squeeze(1)[3].median() < 1e-2  # rad/s
    form = again.form[0]
    assert torch.allclose(form, form.mT, atol=1e-8)
    assert (torch.linalg.eigvalsh(form) > -1e-9).all()


def test_learning_that_diverges_names_the_setting(record: Record, dynamics: Dynamics) -> None:
    fast = SETTINGS.model_copy(update={"learning_rate": 100.0})
    with pytest.raises(LearningError, match=r"diverged; try a smaller ensemble\.learning_rate"):
        Ensemble(few(record(False)[0], 6), dynamics, np.array([1.0, 0.4]), fast, 0, SPAN).learn()


@pytest.mark.parametrize("validation", [0.001, 0.999])
def test_a_window_is_left_out_and_one_is_not(record: Record, dynamics: Dynamics, validation: float) -> None:
    windows, settings = record(False)[0], SETTINGS.model_copy(update={"validation": validation})
    left_out = Ensemble(windows, dynamics, np.ones(2), settings, 0, SPAN).left_out.sum(1)
    assert (left_out == (1 if validation < 0.5 else windows.number - 1)).all()
    with pytest.raises(
        RecordingError, match="a single window to learn from: record longer, or give more windows"
    ):
        Ensemble(few(windows, 1), dynamics, np.ones(2), settings, 0, SPAN)


def test_the_same_seed_learns_the_same(record: Record, dynamics: Dynamics) -> None:
    windows = few(record(False)[0], 4)
    settings = SETTINGS.model_copy(update={"updates": 1, "refresh": 1})
    first, second = (
        Ensemble(windows, dynamics, np.array([1.0, 0.4]), settings, 5, SPAN).learn() for _ in range(2)
    )
    assert all(map(torch.equal, first, second))
