"""Conversion of encoder counts to the measured state and the observation."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cartpole_rl.rig.hardware import Encoders, nominal_encoders
from cartpole_rl.tasks.features import (
    Measured,
    ObservationKind,
    measured_position,
    measured_velocity,
    observe,
)

IP02 = nominal_encoders()


def counts(cart: int, pole: int) -> torch.Tensor:
    return torch.tensor([[cart], [pole]])


class TestPosition:
    def test_travel_is_that_of_the_real_cart(self) -> None:
        travel = 35782 * IP02.metres
        assert travel == pytest.approx(0.814, abs=1e-4)

    @given(
        angle=st.integers(-2048, 2047), turns=st.integers(-(2**30), 2**30), cart=st.integers(-(2**20), 2**20)
    )
    def test_turns_do_not_matter(self, angle: int, turns: int, cart: int) -> None:
        x, theta = measured_position(counts(cart, angle + turns * IP02.turn), IP02)
        assert theta.item() == pytest.approx(angle * 2 * math.pi / 4096, abs=1e-6)
        assert x.item() == pytest.approx(cart * IP02.metres, rel=1e-6)

    @given(cart=st.integers(-(2**20), 2**20), pole=st.integers(-2047, 2047))
    def test_left_mirrors_right(self, cart: int, pole: int) -> None:
        right, left = (
            measured_position(counts(cart, pole), IP02),
            measured_position(counts(-cart, -pole), IP02),
        )
        assert (right[0] + left[0]).item() == 0
        assert (right[1] + left[1]).item() == 0


@given(turn=st.integers(200, 20_000), pole=st.integers(-(2**40), 2**40))
def test_encoders_of_any_number_of_counts_wrap_within_half_a_turn(turn: int, pole: int) -> None:
    x, theta = measured_position(counts(40, pole), Encoders(5e-5, turn))
    assert x.item() == pytest.approx(0.002)
    assert -math.pi - 1e-6 <= theta.item() < math.pi + 1e-6
    assert math.remainder(theta.item() - pole % turn * 2 * math.pi / turn, 2 * math.pi) == pytest.approx(
        0, abs=1e-5
    )


class TestVelocity:
    def test_is_over_the_time_that_passed(self) -> None:
        x_dot, _ = measured_velocity(counts(100, 0), counts(-100, 0), torch.tensor([0.04]), IP02)
        assert x_dot.item() == pytest.approx(200 * IP02.metres / 0.04)

    def test_does_not_jump_where_the_angle_wraps(self) -> None:
        _, theta_dot = measured_velocity(counts(0, 2049), counts(0, 2047), torch.tensor([0.02]), IP02)
        assert theta_dot.item() == pytest.approx(2 * 2 * math.pi / 4096 / 0.02)


class TestObservation:
    state = Measured(*torch.tensor([[0.19, -0.5, math.pi / 6, 4.0], [0.0, 0.0, -3.0, -8.0]]).unbind(1))

    def test_raw_is_the_four_numbers(self) -> None:
        assert observe(self.state, ObservationKind.RAW) == self.state

    def test_cos_sin_is_scaled_to_about_one(self) -> None:
        first = torch.stack(observe(self.state, ObservationKind.COS_SIN), 1)[0]
        torch.testing.assert_close(first, torch.tensor([0.5, -0.5, math.sqrt(3) / 2, 0.5, 0.5]))
