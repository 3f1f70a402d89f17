"""Experiments on a simulated cart keep clear of the ends, and identify the cart."""

import dataclasses
import re
from collections.abc import Callable
from contextlib import closing
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Once
from tensordict import TensorDict

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.guard import stopping_distance
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.identification.checks import check_explained, check_recordings, hardly_explained, stays_up
from cartpole_rl.identification.experiments import (
    EXPERIMENTS,
    HELD_OUT,
    Experiment,
    Moves,
    Task,
    conduct,
    excite,
    experiment_guard,
    free_swing,
    guarded,
    hold,
    reach,
    run,
    track_end,
)
from cartpole_rl.identification.identify import Identification, identify, judged, quantities
from cartpole_rl.identification.one_step import one_step_estimates
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.specs import Numbers, OneCartPlant, PlantOutput
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_encoders, nominal_hardware
from cartpole_rl.tasks.episode import Episode

PERIOD = 0.02
MODELS = Models.of(cart_friction="step", pole_friction="bearing")
TRUTH = {
    "cart_viscous": 0.8,
    "cart_coulomb": 0.4,
    "cart_coulomb_asymmetry": 0.05,
    "pole_viscous": 5e-4,
    "pole_coulomb": 1e-4,
    "force_linear": 0.023,
    "force_offset": -1.3,
    "force_asymmetry": 0.06,
    "latency": 0.016,
    "motor_time_constant": 0.012,
    "track_tilt": 0.003,
    "angle_offset": -0.006,
}
SHORTER = {
    "swing": partial(free_swing, seconds=8.0),
    "excite": partial(excite, seconds=20.0),
    "held_out": partial(excite, seconds=12.0),
}


class SimulatedCart(OneCartPlant):
    """A plant whose frames a test makes up."""

    def _set_seed(self, seed: int | None) -> None: ...

    @property
    def track_half_length(self) -> torch.Tensor:
        return torch.tensor([0.38])


@pytest.fixture(scope="module")
def recordings(make_plant: Callable[..., SimulatedPlant], once: Once) -> dict[str, Episode]:
    def make(_: Path) -> dict[str, Episode]:
        plant = make_plant(1, cart=TRUTH, models=MODELS)
        shorter = tuple(each._replace(moves=SHORTER.get(each.name, each.moves)) for each in EXPERIMENTS)
        return {each.name: episode for each, episode in conduct(plant, PERIOD, experiments=shorter)}

    return once("experiments", make)[1]


@pytest.fixture(scope="module")
def found(recordings: dict[str, Episode], nominal: dict[str, float], once: Once) -> Identification:
    def make(_: Path) -> Identification:
        return identify(*split(recordings), nominal, MODELS, PERIOD, substeps=4, most=40)

    return once("found", make)[1]


def split(recordings: dict[str, Episode]) -> tuple[dict[str, Episode], dict[str, Episode]]:
    """Those that are fitted to, and the held-out one."""
    fitted = {name: episode for name, episode in recordings.items() if name != HELD_OUT}
    return fitted, {HELD_OUT: recordings[HELD_OUT]}


def test_every_experiment_is_made_to_its_end(recordings: dict[str, Episode]) -> None:
    """The cart keeps clear of the ends; the swing is wide and free."""
    assert list(recordings) == [experiment.name for experiment in EXPERIMENTS]
    assert {episode.ended_by for episode in recordings.values()} == {"time"}
    assert sum(episode.steps for episode in recordings.values()) * PERIOD < 600
    farthest = max(np.abs(episode.x).max() for episode in recordings.values())
    assert farthest < reach(PERIOD, nominal_hardware()) + 0.08
    swing = recordings["swing"]
    assert np.abs(swing.theta - np.pi).max() > np.radians(60)
    assert not swing.motor[-round(7.5 / PERIOD) :].any()


def test_the_last_value_sent_is_0_where_the_cart_reports_another_one() -> None:
    sent = []

    class Late(SimulatedCart):
        def step_one(self, motor: int) -> PlantOutput[Numbers]:
            sent.append(motor)
            return at_rest

        def drove(self, given: int) -> int:
            return 0

    at_rest = PlantOutput((0, 2048), (PERIOD,), (0,), (False,), (False,))
    task = Task.of(PERIOD, np.random.default_rng(0), nominal_hardware())
    run(Late(), at_rest, hold(220, 0.1, task), task)
    assert set(sent[:-1]) == {220}
    assert sent[-1] == 0


@pytest.mark.parametrize("experiment", EXPERIMENTS[1:], ids=lambda each: each.name)
def test_a_cart_whose_count_stands_is_not_pushed_into_a_stop(experiment: Experiment) -> None:
    """Its count dithers by one, as that of an encoder with an open wire."""
    hardware, calls = nominal_hardware(), []
    first = PlantOutput((-2000, 2048), (PERIOD,), (0,), (False,), (False,))

    class Blind(SimulatedCart):
        x, speed, farthest, periods = -2000 * nominal_encoders().metres, 0.0, 0.0, 0

        def step_one(self, motor: int) -> PlantOutput[Numbers]:
            self.periods += 1
            force = np.sign(motor) * max(0, abs(motor) - hardware.motor_offset) / hardware.motor_per_newton
            pushed = self.speed + force / hardware.moving_mass * PERIOD
            held = hardware.moving_friction / hardware.moving_mass * PERIOD
            self.speed = float(np.sign(pushed) * max(0, abs(pushed) - held))
            self.x += self.speed * PERIOD
            self.farthest = max(self.farthest, abs(self.x))
            counts = (-2000 + self.periods % 2, 2048 + self.periods % 9)
            return first._replace(counts=counts, motor_applied=(motor,))

        def halt(self) -> None:
            calls.append("halt")

        def distrust(self) -> None:
            calls.append("distrust")

    task = Task.of(PERIOD, np.random.default_rng(0), hardware).knowing(75)
    cart = Blind()
    episode, *_ = run(cart, first, experiment.moves(task), task)
    assert cart.farthest < hardware.half_span
    assert calls == ["halt", "distrust"]
    assert episode.ended_by == "fault"
    assert not episode.steps


def test_a_shorter_track_than_that_of_the_file_is_kept_to() -> None:
    hardware = nominal_hardware()
    assert track_end(hardware, 0.2) < 0.2 < track_end(hardware) == track_end(hardware, 0.5)


def test_the_cart_is_not_driven_after_the_last_experiment(make_plant: Callable) -> None:
    """Also after a fault or off the track: all experiments are then recorded."""

    def push(task: Task) -> Moves:
        yield from hold(255, 3.0, task)
        return None

    resets = []

    class CountedPlant(SimulatedPlant):
        track_half_length = torch.tensor([0.38])  # so that the guard lets it leave the track

        def _reset(self, *given: Any, **named: Any) -> TensorDict:
            resets.append(1)
            return super()._reset(*given, **named)

    plant = make_plant(1, cart={"track_half_length": 0.05}, kind=CountedPlant)
    experiments = tuple(Experiment(name, "nothing", push) for name in ("first", "last"))
    endings = [episode.ended_by for _, episode in conduct(plant, PERIOD, experiments=experiments)]
    assert endings == ["track", "track"]
    assert len(resets) == 2


@pytest.mark.parametrize(("stuck_at", "names"), [(30.0, ["first"]), (24.0, [])])
def test_what_follows_a_frozen_count_is_not_recorded(stuck_at: float, names: list[str]) -> None:
    """Nor a recording without a control period: nothing can be fitted to it."""
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    truth = EmulatorSettings(physics_step=1e-3, stuck_encoder="pole", stuck_at=stuck_at)
    experiments = (Experiment("first", "everything", excite),)
    with closing(emulated_plant(truth)) as plant:
        found = {each.name: episode for each, episode in conduct(plant, PERIOD, experiments=experiments)}
    assert list(found) == names
    for episode in found.values():
        assert episode.ended_by == "fault"
        assert episode.counts[-1, 1] != episode.counts[-2, 1]


def test_a_value_that_came_too_late_is_recorded_as_what_drove(make_plant: Callable) -> None:
    class LatePlant(SimulatedPlant):
        def step_one(self, motor: int) -> PlantOutput[Numbers]:
            given.append(motor)
            return super().step_one(self.drove(motor))

        def drove(self, motor: int) -> int:
            return 0 if len(given) == 3 else motor

    def push(task: Task) -> Moves:
        yield from hold(100, 5 * PERIOD, task)
        return None

    given: list[int] = []
    plant = make_plant(1, kind=LatePlant)
    ((_, recorded),) = conduct(plant, PERIOD, experiments=(Experiment("push", "nothing", push),))
    assert recorded.motor.tolist()[:5] == [100, 100, 0, 100, 100]
    assert given[:5] == [100] * 5


def test_recordings_follow_each_other_on_one_cart(recordings: dict[str, Episode]) -> None:
    """Without resets, each recording starts where the previous one ended, with the cart at rest."""
    for before, after in pairwise(recordings.values()):
        assert before.motor[-1] == 0
        assert after.x[0] == pytest.approx(before.x[-1], abs=1e-3)
        assert abs(before.x[-1]) > 1e-3  # a reset would have put it into the middle


@pytest.mark.parametrize(
    ("x", "x_dot", "motor", "given"),
    [
        (0.0, 0.0, 180, 180),
        (0.3, 0.0, 180, -220),
        (-0.3, 0.0, -180, 220),
        (0.2, 0.8, 100, -220),
        (0.3, 0.0, -250, -250),
        (0.0, 0.0, 400, 255),
    ],
)
def test_the_guard_brakes(x: float, x_dot: float, motor: int, given: int) -> None:
    assert guarded(motor, x, x_dot, experiment_guard(PERIOD, nominal_hardware()), 0.2874) == given


NOMINAL = nominal_hardware()
SLIPPERY = hardware_of({"moving_friction": 0, "motor_offset": 0, "motor_per_newton": 30})
GAIN = 1 / 0.24  # m/s^2, of the nominal cart at full motor value


STRONGER = 255 / 30 / 0.85 * GAIN / (180 / 50 / 0.85)


@pytest.mark.parametrize(
    ("rig", "period", "gain", "brake"),
    [
        *((NOMINAL, period, GAIN, GAIN) for period in (0.005, 0.02, 0.1)),
        *((SLIPPERY, period, STRONGER, 220 / 30 / 0.85) for period in (0.005, 0.02, 0.03)),
    ],
)
@pytest.mark.parametrize("speed", [0.0, 0.5, 1.0])
def test_the_guard_allows_for_a_period_in_which_it_does_not_act(
    rig: Hardware, period: float, gain: float, brake: float, speed: float
) -> None:
    """Where it lets a cart run, one that gains speed for a period more and is then braked stays within.

    The brake of a cart with little friction is weaker than its motor at full value.
    """
    guard, late, end = experiment_guard(period, rig), period + 0.035, track_end(rig)
    assert guard.deceleration == pytest.approx(brake)
    true_speed = speed + gain * period / 2  # the measured one is half a period old
    ran_on = true_speed * late + gain * late**2 / 2
    stopped = (true_speed + gain * late) ** 2 / (2 * brake)
    assert end - stopping_distance(speed, guard) + ran_on + stopped <= end + 1e-4


def test_a_cart_too_strong_for_its_track_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^control_period=0\.1: .* m/s\^2; .* a shorter period"):
        experiment_guard(0.1, SLIPPERY)
    offset = {"motor_offset": 240, "motor_per_newton": 5, "moving_friction": 0.5}
    with pytest.raises(ConfigError, match=r"^cart\.motor_offset=240: .* brakes no such cart; give less$"):
        experiment_guard(0.02, hardware_of(offset))


LIGHT = {"cart_mass": 0.57}
HEAVY = {"cart_mass": 1.1, "pole_mass": 0.23, "pole_com": 0.33, "pole_inertia": 7.88e-3}


@pytest.mark.parametrize(
    ("cart", "names"),
    [
        pytest.param(LIGHT, ("coast", "levels", "square", "excite"), marks=pytest.mark.nightly),
        (HEAVY, ("excite",)),
    ],
)
def test_an_emulated_cart_keeps_within_0_3_m_at_long_periods(
    cart: dict[str, float], names: tuple[str, ...]
) -> None:
    """Random motor values try the guard most."""
    chosen, period = tuple(each for each in EXPERIMENTS if each.name in names), 0.1
    with closing(emulated_plant(EmulatorSettings(physics_step=1e-3, **cart), period)) as plant:
        recorded = [episode for _, episode in conduct(plant, period, seed=1, experiments=chosen)]
    assert {episode.ended_by for episode in recorded} == {"time"}
    assert max(np.abs(episode.x).max() for episode in recorded) < 0.3
    assert sum(episode.steps for episode in recorded) * period < 200  # runs start within the guard's reach


def test_the_cart_is_found(found: Identification, nominal: dict[str, float]) -> None:
    true = {each.name: each.value for each in quantities({**nominal, **TRUTH})}
    values = {each.name: each.value for each in quantities(found.fit.parameters)}
    for name, share in {
        "pole_frequency": 0.002,
        "force_gain": 0.01,
        "deadband": 0.02,
        "viscous": 0.05,
        "coulomb": 0.05,
        "pole_damping": 0.1,
    }.items():
        assert values[name] == pytest.approx(true[name], rel=share), name
    for name, off in {"force_asymmetry": 0.02, "angle_offset": 0.002}.items():
        assert found.fit.parameters[name] == pytest.approx(TRUTH[name], abs=off), name
    early = 2.5  # ms: the simulated cart's step is 5 ms, and (3.8) moves it half of one early
    assert values["latency"] == pytest.approx(true["latency"] - early, abs=1.0)
    assert values["lag"] == pytest.approx(true["lag"], abs=1.0)


def test_the_true_friction_law_predicts_best(found: Identification) -> None:
    errors = {each.cart_friction: each.error.size for each in found.candidates}
    assert list(errors) == ["linear", "sigmoid", "step", "stribeck"]
    assert found.models.cart_friction in ("step", "stribeck")
    assert errors["linear"] > 3 * errors["step"]  # type: ignore[index]
    assert found.error.x < 1e-3
    assert found.error.theta < np.radians(0.5)


def test_draws_cover_the_cart(found: Identification, nominal: dict[str, float]) -> None:
    drawn = CartParameters(torch.from_numpy(found.fit.draw(500, np.random.default_rng(0))))
    ratio = drawn.cart_viscous / drawn.total_mass
    assert 1e-4 < ratio.std() / ratio.mean() < 0.1
    assert (drawn.pole_mass == nominal["pole_mass"]).all()


def test_a_one_step_fit_of_the_same_recordings_fails(
    recordings: dict[str, Episode], nominal: dict[str, float]
) -> None:
    """The thesis's way: at 50 Hz one count of difference is 0.077 rad/s, and delay and lag are left out."""
    estimates = one_step_estimates([*split(recordings)[0].values()], nominal, MODELS, PERIOD)
    assert abs(estimates["cart_coulomb"].value / TRUTH["cart_coulomb"] - 1) > 0.3  # trajectories: within 5 %


def refused(recordings: dict[str, Episode], *names: str, **replaced: Episode) -> str:
    """The message for the held-out recording and those with `names`, or all; some of them are replaced."""
    fitted, held_out = split({**recordings, **replaced})
    with pytest.raises(RecordingError) as raised:
        check_recordings({name: fitted[name] for name in names or fitted}, held_out, PERIOD)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def still(values: np.ndarray) -> np.ndarray:
    return np.full_like(values, values[0])


def half_still(values: np.ndarray) -> np.ndarray:
    return np.concatenate((values[:300], np.full(len(values) - 300, values[300])))


FROZEN_CART, FROZEN_POLE = {"x": still, "cart": still}, {"theta": still, "pole": still}


class TestChecks:
    def test_good_recordings_pass(self, recordings: dict[str, Episode]) -> None:
        check_recordings(*split(recordings), PERIOD)

    def test_a_recording_alone(self, recordings: dict[str, Episode], monkeypatch: pytest.MonkeyPatch) -> None:
        assert "too short; record 20 s or more" in refused(recordings, "square")
        fitted, held_out = split(recordings)
        check_recordings({"excite": fitted["excite"]}, held_out, PERIOD)  # its motion tells its zero
        monkeypatch.setattr("cartpole_rl.identification.checks.ZERO_INTERVAL", 1e-3)
        assert "never hangs still" in refused(recordings, "excite")

    @pytest.mark.parametrize(("angle", "seconds", "up"), [(0.2, 6, True), (0.2, 4, False), (0.5, 6, False)])
    def test_a_balanced_pole_tells_its_zero(
        self, recordings: dict[str, Episode], angle: float, seconds: float, up: bool
    ) -> None:
        excite = recordings["excite"]
        balanced = np.arange(len(excite.theta)) * PERIOD < seconds
        leaning = np.where(balanced, angle * np.sin(np.arange(len(balanced))), excite.theta + np.pi / 2)
        assert stays_up(dataclasses.replace(excite, theta=leaning), PERIOD) == up
        on_a_stop = np.where(balanced, angle, leaning)
        assert not stays_up(dataclasses.replace(excite, theta=on_a_stop), PERIOD)

    @pytest.mark.parametrize("name", ["ramps", HELD_OUT])
    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"motor": lambda motor: 0 * motor}, "the motor value is 0 throughout; record it with others"),
            ({"motor": lambda motor: 0 * motor + 120}, "the motor value is 120 throughout"),
            (FROZEN_CART, "the cart moves 0 mm in all"),
            (FROZEN_POLE, "the pole"),
            ({**FROZEN_CART, **FROZEN_POLE}, "the cart moves 0 mm in all"),
            (
                {name: lambda values: 0 * values for name in (*FROZEN_CART, *FROZEN_POLE, "motor")},
                "throughout",
            ),
            ({"theta": np.degrees}, "theta is not its encoder's count times"),
            ({"x": lambda x: 1e3 * x}, "x is not its encoder's count times"),
            (
                {"time": lambda time: 1.1 * time},
                "a frame every 22 ms, not every 20 ms: give control_period=0.022",
            ),
        ],
    )
    def test_each_recording_is_checked_and_named(
        self, recordings: dict[str, Episode], name: str, changes: dict[str, Any], said: str
    ) -> None:
        message = refused(recordings, **{name: changed(recordings[name], **changes)})
        assert message.startswith(f"{name}: ")
        assert said in message

    @pytest.mark.parametrize("name", ["excite", HELD_OUT])
    @pytest.mark.parametrize("encoder", ["cart", "pole"])
    def test_an_encoder_that_freezes_later(
        self, recordings: dict[str, Episode], name: str, encoder: str
    ) -> None:
        position = {"cart": "x", "pole": "theta"}[encoder]
        frozen = changed(recordings[name], **{position: half_still, encoder: half_still})
        message = refused(recordings, **{name: frozen})
        assert message.startswith(f"{name}: the {encoder}'s count stays at ")
        assert "the encoder is frozen, saturated or unplugged; check its cable" in message

    def test_a_held_out_recording_that_is_too_short(self, recordings: dict[str, Episode]) -> None:
        short = recordings[HELD_OUT].part(0, 100)
        assert refused(recordings, **{HELD_OUT: short}).startswith(
            f"{HELD_OUT}: 2.0 s are too short to judge"
        )

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"motor": lambda motor: -motor}, "swap the motor's wires"),
            (
                {
                    "theta": lambda theta: 2 * np.pi - theta,
                    "pole": lambda counts: nominal_encoders().turn - counts,
                },
                "swap the pole encoder's channels",
            ),
        ],
    )
    def test_swapped_wires(self, recordings: dict[str, Episode], changes: dict[str, Any], said: str) -> None:
        assert said in refused({name: changed(each, **changes) for name, each in recordings.items()})

    def test_a_saturated_cart_encoder(self, recordings: dict[str, Episode]) -> None:
        most = 9000
        saturated = changed(
            recordings["excite"],
            x=lambda x: x.clip(-most * nominal_encoders().metres, most * nominal_encoders().metres),
            cart=lambda counts: counts.clip(-most, most),
        )
        message = refused(recordings, excite=saturated)
        assert re.search(r"^excite: the cart('s count stays| stops dead) at -?9000 ", message), message


@pytest.mark.parametrize("name", ["excite", HELD_OUT])
def test_a_recording_that_no_such_cart_moves_like_is_refused(
    recordings: dict[str, Episode], found: Identification, name: str
) -> None:
    """By the name of its file."""
    fitted, held_out = split(recordings)
    assert len(check_explained({name: recordings[name]}, found.dynamics, 1.0)) == 1
    others = {name: changed(recordings[name], motor=lambda motor: np.roll(motor, 40))}
    fitted = fitted | others if name in fitted else fitted
    with pytest.raises(RecordingError, match=rf"^{name}: no cart explains this recording: 1 s of the "):
        judged(found.fit, found.dynamics, found.candidates, fitted, held_out | others)


def test_a_recording_that_is_too_short_to_be_refused_is_warned_of(
    recordings: dict[str, Episode], found: Identification
) -> None:
    part = recordings[HELD_OUT].part(50, 95)
    for motor, expected in ((part.motor, 0), (-part.motor, 1)):
        recording = {"part": changed(part, motor=lambda _, given=motor: given)}
        replays = check_explained(recording, found.dynamics, 1.0)
        warned = hardly_explained(recording, replays, found.dynamics)
        assert len(warned) == expected
        start = "part: no cart explains this recording: 0.3 s of the "
        assert all(each.startswith(start) for each in warned)


def test_the_recording_of_which_the_cart_explains_least_is_named(
    recordings: dict[str, Episode], found: Identification
) -> None:
    late, later = (changed(recordings[HELD_OUT], motor=partial(np.roll, shift=shift)) for shift in (10, 40))
    for order in ({"late": late, "later": later}, {"later": later, "late": late}):
        with pytest.raises(RecordingError, match=r"^later: no cart explains this recording"):
            check_explained(order, found.dynamics, 1.0)
    with pytest.raises(RecordingError, match=r"^late: "):
        check_explained({"late": late}, found.dynamics, 1.0)


def test_held_out_recordings_that_give_no_error_are_refused_before_the_fit(
    recordings: dict[str, Episode], nominal: dict[str, float]
) -> None:
    fitted, held_out = split(recordings)
    short = {str(first): held_out[HELD_OUT].part(first, first + 45) for first in range(0, 450, 45)}
    fits: list[None] = []
    with pytest.raises(
        RecordingError,
        match=r"the held-out recordings: no recording holds 1 s without a lost frame: record longer, or",
    ):
        identify(fitted, short, nominal, MODELS, PERIOD, 4, 40, on_step=lambda: fits.append(None))
    assert not fits


def test_the_held_out_recording_changes_the_reported_error_alone(
    recordings: dict[str, Episode], found: Identification
) -> None:
    fitted, held_out = split(recordings)
    start = {HELD_OUT: held_out[HELD_OUT].part(0, 400)}
    again = judged(found.fit, found.dynamics, found.candidates, fitted, start)
    assert again.fit is found.fit
    assert again.error != found.error
    assert again.warnings == found.warnings


def changed(episode: Episode, **changes: Callable[[np.ndarray], np.ndarray]) -> Episode:
    """The episode with other columns; `cart` and `pole` are its counts."""
    counts = episode.counts.copy()
    for column, name in enumerate(("cart", "pole")):
        counts[:, column] = changes.pop(name, np.copy)(counts[:, column])
    values: Any = {name: change(getattr(episode, name)) for name, change in changes.items()}
    return dataclasses.replace(episode, counts=counts, **values)
