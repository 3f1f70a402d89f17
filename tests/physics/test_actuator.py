"""The actuator: force curve, dead-bands, lag and latency."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cartpole_rl.physics.actuator import ACTUATORS, lagged_force, mean_commands
from cartpole_rl.physics.dynamics import Drive, State, advance, mechanism, run_period
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters

MakeCart = Callable[..., CartParameters]
LEVELS = torch.tensor([-250.0, -200, -150, -100, 0, 100, 150, 200, 250], dtype=torch.float64)
NEWTONS = torch.tensor([-4.0, -3, -2, -1, 0, 1, 2, 3, 4], dtype=torch.float64)


def at(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


class TestForceCurve:
    @pytest.mark.parametrize("model", ACTUATORS)
    def test_thesis_levels(self, make_cart: MakeCart, model: Law) -> None:
        torch.testing.assert_close(model(LEVELS, make_cart(9)), NEWTONS)

    @pytest.mark.parametrize("model", ACTUATORS)
    def test_is_exact_in_single_precision(self, make_cart: MakeCart, model: Law) -> None:
        cart = CartParameters.from_table(
            torch.stack([getattr(make_cart(9), name) for name in CartParameters.names()]).float()
        )
        torch.testing.assert_close(model(LEVELS.float(), cart), NEWTONS.float(), rtol=0, atol=1e-6)

    @pytest.mark.parametrize("model", ACTUATORS)
    def test_small_values_do_not_move_the_cart(self, make_cart: MakeCart, model: Law) -> None:
        assert (model(at(-50, -30, 0, 30, 50), make_cart(5)) == 0).all()

    def test_is_the_quadratic_fit(self, make_cart: MakeCart) -> None:
        cart = make_cart(2, force_quadratic=1e-5, force_linear=0.01, force_offset=-0.3)
        force = ACTUATORS.find("force_curve")(at(120, -240), cart)
        torch.testing.assert_close(force, at(1e-5 * 120**2 + 1.2 - 0.3, -(1e-5 * 240**2 + 2.4 - 0.3)))

    def test_dead_bands_are_of_each_side(self, make_cart: MakeCart) -> None:
        cart = make_cart(4, deadband_left=120.0, deadband_right=80.0)
        force = ACTUATORS.find("force_curve")(at(-120, -121, 80, 81), cart)
        torch.testing.assert_close(force, at(0, -1.42, 0, 0.62))

    def test_asymmetry_is_of_the_right_side(self, make_cart: MakeCart) -> None:
        force = ACTUATORS.find("force_curve")(at(-200, 200), make_cart(2, force_asymmetry=0.1))
        torch.testing.assert_close(force, at(-3.0, 3.3))

    def test_no_motor_value_no_force(self, make_cart: MakeCart) -> None:
        assert ACTUATORS.find("force_curve")(at(0), make_cart(1, force_offset=1.0)).item() == 0

    def test_newtons_ignore_the_parameters_of_the_cart(self, make_cart: MakeCart) -> None:
        cart = make_cart(9, force_linear=0.5, force_asymmetry=0.3, deadband_left=200.0)
        torch.testing.assert_close(ACTUATORS.find("newtons")(LEVELS, cart), NEWTONS)


class TestLag:
    @pytest.mark.parametrize("time_constant", [0.001, 0.01, 0.1])
    def test_is_the_analytic_solution(self, time_constant: float) -> None:
        force, target, step = 1.0, 4.0, 0.02
        mean, end = lagged_force(at(force), at(target), at(time_constant), step)
        assert end.item() == pytest.approx(target + (force - target) * math.exp(-step / time_constant))
        time = (torch.arange(200_000, dtype=torch.float64) + 0.5) * step / 200_000
        average = (target + (force - target) * torch.exp(-time / time_constant)).mean().item()
        assert mean.item() == pytest.approx(average, rel=1e-8)

    def test_steps_add_up(self) -> None:
        whole, end = lagged_force(at(1.0), at(-3.0), at(0.015), 0.02)
        first, middle = lagged_force(at(1.0), at(-3.0), at(0.015), 0.01)
        second, end_of_second = lagged_force(middle, at(-3.0), at(0.015), 0.01)
        torch.testing.assert_close((first + second) / 2, whole)
        torch.testing.assert_close(end_of_second, end)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_none_without_a_time_constant(self, dtype: torch.dtype) -> None:
        mean, end = (
            force.item()
            for force in lagged_force(
                *(torch.tensor([value], dtype=dtype) for value in (0.0, 4.0, 0.0)), 0.01
            )
        )
        assert mean == pytest.approx(4.0, rel=1e-9)
        assert end == 4.0


def shares(latency: float, commands: int, period: float, substeps: int) -> Tensor:
    """Share of each step in which each command is in force, [substeps, commands]: the mean of ones."""
    held = torch.eye(commands, dtype=torch.float64).unbind()
    return torch.stack(mean_commands(held, at(latency), period, substeps))


class TestLatency:
    @given(
        latency=st.floats(0, 0.1),
        period=st.floats(0.005, 0.1),
        substeps=st.integers(1, 10),
        more=st.integers(0, 3),
    )
    def test_shares_sum_to_one(self, latency: float, period: float, substeps: int, more: int) -> None:
        share = shares(latency, 2 + math.ceil(latency / period) + more, period, substeps)
        assert ((share >= 0) & (share <= 1)).all()
        torch.testing.assert_close(share.sum(1), torch.ones(substeps, dtype=torch.float64))

    @pytest.mark.parametrize(
        ("latency", "expected"),
        [
            (0.0, [[1, 0, 0], [1, 0, 0]]),
            (0.005, [[0.5, 0.5, 0], [1, 0, 0]]),
            (0.02, [[0, 1, 0], [0, 1, 0]]),
            (0.034, [[0, 0, 1], [0, 0.6, 0.4]]),
        ],
    )
    def test_a_command_takes_over_when_its_latency_has_passed(
        self, latency: float, expected: list[list[float]]
    ) -> None:
        torch.testing.assert_close(shares(latency, 3, 0.02, 2), torch.tensor(expected, dtype=torch.float64))

    @pytest.mark.parametrize("actuator", ACTUATORS)
    @pytest.mark.parametrize("periods", [0.0, 0.5, 1.0, 1.7])
    def test_latency_equals_later_commands(self, make_cart: MakeCart, periods: float, actuator: Law) -> None:
        period, substeps, count = 0.02, 10, 40
        step, cart = period / substeps, make_cart()
        generator = torch.Generator().manual_seed(0)
        commands = 50.0 * torch.randint(-5, 6, (count, 1), generator=generator).to(torch.float64)
        models = Models(CART_FRICTIONS.find("stribeck"), POLE_FRICTIONS.find("exponential"), actuator)
        start = State(at(0), at(0), at(math.pi), at(0))

        delayed, drive = start, Drive(at(0), torch.zeros(3, 1, dtype=torch.float64))
        for command in commands:
            drive = drive._replace(motors=torch.cat((command.unsqueeze(0), drive.motors[:-1])))
            delayed, drive = run_period(delayed, drive, at(periods * period), cart, models, period, substeps)

        plain, body, late = start, mechanism(cart), round(periods * substeps)
        for index in range(count * substeps):
            given = commands[(index - late) // substeps] if index >= late else torch.zeros(1)
            plain = advance(plain, actuator(given, cart), cart, body, models, step)

        torch.testing.assert_close(torch.stack(delayed), torch.stack(plain), rtol=0, atol=1e-9)
