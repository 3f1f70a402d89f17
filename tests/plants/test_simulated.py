"""The simulated plant: encoders, delays, draws in each episode, and going on from a snapshot."""

import math
import pickle
from collections.abc import Callable
from functools import partial

import pytest
import torch
from courses import ANYWHERE
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from cartpole_rl.physics.dynamics import State
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.rig.hardware import nominal_encoders

MakePlant = Callable[..., SimulatedPlant]
NOISY = {
    "latency_jitter": Range(absolute=(0.001, 0.005)),
    "position_noise": Range(absolute=(1e-4, 1e-3)),
    "angle_noise": Range(absolute=(1e-3, 1e-2)),
    "cart_mass": Range(relative=(-0.2, 0.2)),
}


def push(plant: SimulatedPlant, *motors: int) -> TensorDict:
    """The frame after one period under a motor value, of all carts or one each."""
    motor = torch.tensor(motors).expand(plant.carts).unsqueeze(1)
    return plant.step(TensorDict({"motor": motor}, [plant.carts]))["next"]


def reset_rows(plant: SimulatedPlant, *rows: int) -> TensorDict:
    mask = torch.zeros(plant.carts, 1, dtype=torch.bool)
    mask[list(rows)] = True
    return plant.reset(TensorDict({"_reset": mask}, [plant.carts]))


def random_motors(count: int, carts: int) -> Tensor:
    return torch.randint(-255, 256, (count, carts), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("carts", [1, 5])
def test_specs(make_plant: MakePlant, carts: int) -> None:
    check_env_specs(make_plant(carts, ranges=NOISY, start=ANYWHERE))


class TestFrame:
    def test_counts_are_the_true_state_in_whole_counts(self, make_plant: MakePlant) -> None:
        plant = make_plant(64, cart={"angle_offset": 0.02}, start=ANYWHERE)
        for look in (plant.reset, lambda: push(plant, 200)):
            frame = look()
            x = frame["counts"][:, 0] * nominal_encoders().metres - plant.true_state.x
            theta = frame["counts"][:, 1] * nominal_encoders().radians - plant.true_state.theta - 0.02
            assert x.abs().max() <= 0.501 * nominal_encoders().metres
            assert theta.abs().max() <= 0.501 * nominal_encoders().radians

    def test_the_poles_turns_are_counted(self, make_plant: MakePlant) -> None:
        plant = make_plant(cart={"cart_mass": 100.0})
        plant.reset()
        spinning = torch.tensor([30.0])
        plant.place(State(torch.zeros(1), torch.zeros(1), torch.zeros(1), spinning))
        for _ in range(50):
            frame = push(plant, 0)
        assert frame["counts"][0, 1] > 3 * 4096

    @pytest.mark.parametrize(
        ("latency", "in_force"),
        [(0.0, [10, 20, 30, 40]), (0.02, [10, 20, 30, 40]), (0.021, [0, 10, 20, 30]), (0.05, [0, 0, 10, 20])],
    )
    def test_motor_applied_is_the_one_in_force_at_the_end(
        self, make_plant: MakePlant, latency: float, in_force: list[int]
    ) -> None:
        plant = make_plant(cart={"latency": latency})
        plant.reset()
        assert [push(plant, motor)["motor_applied"].item() for motor in (10, 20, 30, 40)] == in_force

    @pytest.mark.parametrize("side", [1, -1])
    def test_the_end_of_the_track_terminates(self, make_plant: MakePlant, side: int) -> None:
        plant = make_plant()
        plant.reset()
        for _ in range(200):
            frame = push(plant, side * 250)
            beyond = side * plant.true_state.x.item() > plant.parameters.track_half_length.item()
            assert frame["terminated"].item() == frame["done"].item() == beyond
            assert not frame["truncated"].item()
            if beyond:
                return
        pytest.fail("the cart never left the track")

    def test_a_reset_forgets_the_motor(self, make_plant: MakePlant) -> None:
        plant = make_plant(cart={"latency": 0.03, "motor_time_constant": 0.05})
        plant.reset()
        for _ in range(5):
            push(plant, 250)
        plant.reset()
        push(plant, 0)
        assert plant.true_state.x.item() == pytest.approx(0, abs=1e-9)


class TestDraws:
    def test_differ_between_carts_and_episodes(self, make_plant: MakePlant) -> None:
        plant = make_plant(8, ranges={"cart_mass": Range(relative=(-0.2, 0.2))})
        seen = []
        for _ in range(3):
            plant.reset()
            seen.append(plant.parameters.cart_mass.clone())
        assert len(torch.cat(seen).unique()) == 24

    def test_are_anew_only_for_the_rows_that_reset(self, make_plant: MakePlant) -> None:
        plant = make_plant(4, ranges={"cart_mass": Range(relative=(-0.2, 0.2))}, start=ANYWHERE)
        plant.reset()
        push(plant, 250)
        before = plant.parameters.cart_mass.clone(), torch.stack(plant.true_state, 1)
        reset_rows(plant, 1, 2)
        after = plant.parameters.cart_mass, torch.stack(plant.true_state, 1)
        assert (before[0] != after[0]).tolist() == [False, True, True, False]
        assert (before[1] != after[1]).any(1).tolist() == [False, True, True, False]

    def test_rows_that_do_not_reset_go_on_undisturbed(self, make_plant: MakePlant) -> None:
        carts = {name: make_plant(2, cart={"latency": 0.03}, start=ANYWHERE, seed=3) for name in ("a", "b")}
        for plant in carts.values():
            plant.reset()
            push(plant, 250)
        reset_rows(carts["b"], 1)
        for _ in range(10):
            a, b = (push(plant, 100)["counts"] for plant in carts.values())
        assert (a == b).all(1).tolist() == [True, False]

    def test_starts_fit_on_the_track_that_is_drawn(self, make_plant: MakePlant) -> None:
        """On a short one they are uniform over three quarters of it; a long one changes nothing."""
        ranges = {"track_half_length": Range(absolute=(0.1, 0.5))}
        plant = make_plant(20_000, ranges=ranges, start=ANYWHERE)
        plant.reset()
        track, place = plant.track_half_length, plant.true_state.x
        spread = (0.75 * track).clamp(max=ANYWHERE.position_spread)
        share = (place / spread + 1) / 2
        for rows in (track < 0.2, track > 0.4):
            values = share[rows].sort().values
            assert (values - torch.linspace(0, 1, len(values))).abs().max() < 0.03
        plant.restart(torch.arange(20_000), torch.ones(20_000, dtype=torch.bool))  # the same carts
        assert (plant.true_state.x.abs() <= spread + 1e-6).all()
        assert not push(plant, 0)["terminated"].any()

    def test_are_repeated_by_the_seed(self, make_plant: MakePlant) -> None:
        def course(seed: int) -> Tensor:
            plant = make_plant(4, ranges=NOISY, start=ANYWHERE, seed=seed)
            plant.reset()
            return torch.stack([push(plant, *row.tolist())["counts"] for row in random_motors(20, 4)])

        assert (course(0) == course(0)).all()
        assert (course(0) != course(1)).any()

    def test_pole_length_is_that_of_the_pole_in_force(
        self, make_plant: MakePlant, both_poles: PoleSettings
    ) -> None:
        plant = make_plant(64, poles=both_poles)
        plant.reset()
        torch.testing.assert_close(plant.pole_length, 2 * plant.parameters.pole_com)
        assert len(plant.pole_length.unique()) == 2


def test_a_snapshot_goes_on_as_if_nothing_had_happened_in_another_plant_too(make_plant: MakePlant) -> None:
    delays = {"latency": Range(absolute=(0.0, 0.04)), "motor_time_constant": Range(absolute=(0.0, 0.05))}
    stribeck = Models(CART_FRICTIONS.find("stribeck"))
    build = partial(make_plant, 4, ranges={**NOISY, **delays}, start=ANYWHERE, models=stribeck)

    def course(plant: SimulatedPlant, motors: Tensor) -> Tensor:
        """Counts [T, N] with resets on the way."""
        frames = []
        for index, row in enumerate(motors):
            frames.append(push(plant, *row.tolist())["counts"])
            if index % 7 == 6:
                reset_rows(plant, index % plant.carts)
        return torch.stack(frames)

    plant, motors = build(), random_motors(60, 4)
    plant.reset()
    course(plant, motors[:30])
    snapshot = plant.snapshot()
    first = course(plant, motors[30:])
    for again in (plant, build(seed=99)):
        again.restore(snapshot)
        assert (course(again, motors[30:]) == first).all()


def test_a_pickled_plant_reads_the_carts_that_it_draws(make_plant: MakePlant) -> None:
    copy = pickle.loads(pickle.dumps(make_plant(3)))
    assert copy.parameters.table.data_ptr() == copy._carts.table.data_ptr()


def test_more_substeps_change_little(make_plant: MakePlant) -> None:
    """2 a period, as in training, against 40: 1 s of a driven swing ends within 1 cm and 5 degrees."""
    ends = []
    for substeps in (2, 40):
        plant = make_plant(substeps=substeps)
        plant.reset()
        for index in range(50):
            push(plant, 200 if (index // 12) % 2 == 0 else -200)
        ends.append(plant.true_state)
    assert abs(ends[0].x - ends[1].x).item() < 0.01
    assert abs(ends[0].theta - ends[1].theta).item() < math.radians(5)
