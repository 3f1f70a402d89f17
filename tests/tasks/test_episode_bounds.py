"""Starts and ends of episodes, and the definition of upright."""

import math

import numpy as np
import pytest
import torch

from cartpole_rl.envs.perception import fallen
from cartpole_rl.randomization.randomizer import draw_start
from cartpole_rl.tasks.episode import is_upright, upright_since, wrap
from cartpole_rl.tasks.features import Measured
from cartpole_rl.tasks.rewards import BALANCE_ANGLE
from cartpole_rl.tasks.settings import CENTRED, Start, StartSettings

SPREAD = {"position_spread": 0.2, "angle_spread": 0.1, "speed_spread": 0.3, "angular_speed_spread": 1.0}


def draw(angle: Start, **changes: float) -> torch.Tensor:
    settings = StartSettings(angle=angle, **{**SPREAD, **changes})
    return draw_start(20_000, settings, torch.Generator().manual_seed(0)).double()


class TestStarts:
    @pytest.mark.parametrize(
        ("angle", "about", "spread"),
        [(Start.UPRIGHT, 0.0, 0.1), (Start.HANGING, math.pi, 0.1), (Start.ANY, 0.0, math.pi)],
    )
    def test_each_number_is_uniform_within_its_spread(
        self, angle: Start, about: float, spread: float
    ) -> None:
        state = draw(angle) - torch.tensor([0, 0, about, 0])
        for column, limit in zip(state.T, (0.2, 0.3, spread, 1.0), strict=True):
            share = (column.sort().values + limit) / (2 * limit)
            assert ((share > -1e-6) & (share < 1 + 1e-6)).all()
            assert (share - torch.linspace(0, 1, len(share))).abs().max() < 0.02

    def test_no_spread_is_the_same_start_each_time(self) -> None:
        state = draw(Start.HANGING, position_spread=0, angle_spread=0, speed_spread=0, angular_speed_spread=0)
        torch.testing.assert_close(state, torch.tensor([[0, 0, math.pi, 0]]).double().expand_as(state))

    def test_a_share_starts_hanging_at_rest(self) -> None:
        state = draw(Start.ANY, resting_share=0.3)
        rests = (state[:, 1] == 0) & (state[:, 3] == 0)
        assert rests.double().mean().item() == pytest.approx(0.3, abs=0.02)
        torch.testing.assert_close(state[rests, 2], torch.full_like(state[rests, 2], math.pi))
        assert state[rests, 0].abs().max() > 0.19
        assert state[~rests, 2].abs().max() < math.pi + 1e-6

    def test_a_share_of_these_starts_in_the_middle(self) -> None:
        state = draw(Start.ANY, resting_share=0.5, centred_share=0.4)
        rests = (state[:, 1] == 0) & (state[:, 3] == 0)
        centred = state[:, 0].abs() <= CENTRED
        assert centred[rests].double().mean().item() == pytest.approx(0.4 + 0.6 * CENTRED / 0.2, abs=0.02)
        assert centred[~rests].double().mean().item() == pytest.approx(CENTRED / 0.2, abs=0.02)

    def test_the_generator_decides(self) -> None:
        assert (draw(Start.ANY) == draw(Start.ANY)).all()


class TestFallen:
    still = torch.zeros(6)
    state = Measured(still, still, torch.tensor([0.0, 0.2, 0.21, -0.2, -0.21, math.pi]), still)

    def test_beyond_twelve_degrees_on_either_side(self) -> None:
        assert math.degrees(BALANCE_ANGLE) == pytest.approx(12)
        assert fallen(self.state.theta, BALANCE_ANGLE).tolist() == [False, False, True, False, True, True]

    def test_never_without_a_limit(self) -> None:
        assert fallen(self.state.theta, None).tolist() == [False] * 6


class TestUpright:
    def test_angles_wrap(self) -> None:
        turns = 2 * np.pi * np.arange(-3, 4)
        np.testing.assert_allclose(wrap(1.0 + turns), 1.0)
        np.testing.assert_allclose(wrap(-1.0 + turns), -1.0)
        np.testing.assert_allclose(wrap(np.array([np.pi, -np.pi])), np.pi)

    def test_within_five_degrees(self) -> None:
        degrees = np.array([0, 4.9, -4.9, 5.1, -5.1, 364, 180])
        assert is_upright(np.radians(degrees)).tolist() == [True, True, True, False, False, True, False]

    def test_has_to_be_held_for_a_second(self) -> None:
        time = np.arange(0, 4, 0.02)
        theta = np.where((time > 0.5) & (time < 1.0) | (time > 2.0), 0.0, 1.0)
        assert upright_since(time, theta) == pytest.approx(2.02)
        assert upright_since(time[time < 2.9], theta[time < 2.9]) is None
