"""The actuator: force curve, dead-bands, lag and latency."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cartpole_rl.physics.actuator import ACTUATORS, force_curve, lag_shares, mean_commands, newtons
from cartpole_rl.physics.dynamics import Drive, State, advance, mechanism, run_period
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters

MakeCart = Callable[..., CartParameters]
LEVELS = torch.tensor([-250.0, -200, -150, -100, 0, 100, 150, 200, 250], dtype=torch.float64)
NEWTONS = torch.tensor([-4.0, -3, -2, -1, 0, 1, 2, 3, 4], dtype=torch.float64)


def at(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("law", ACTUATORS, ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_thesis_levels(make_cart: MakeCart, law: Law, dtype: torch.dtype) -> None:
    cart = CartParameters(make_cart(9).table.to(dtype))
    torch.testing.assert_close(law(LEVELS.to(dtype), cart), NEWTONS.to(dtype), rtol=0, atol=1e-6)
    small = at(-50, -30, -1, 0, 0, 1, 10, 30, 50).to(dtype)
    assert (law(small, cart) == 0).all()


@pytest.mark.parametrize(
    ("changes", "motors", "forces"),
    [
        (
            {"force_quadratic": 1e-5, "force_linear": 0.01, "force_offset": -0.3},
            (120, -240),
            (1e-5 * 120**2 + 1.2 - 0.3, -(1e-5 * 240**2 + 2.4 - 0.3)),
        ),
        ({"deadband_left": 120.0, "deadband_right": 80.0}, (-120, -121, 80, 81), (0, -1.42, 0, 0.62)),
        ({"force_asymmetry": 0.1}, (-200, 200), (-3.0, 3.3)),
        ({"force_offset": 1.0}, (0,), (0,)),
    ],
    ids=["quadratic", "a dead-band of each side", "more to the right", "none at 0"],
)
def test_force_curve(
    make_cart: MakeCart, changes: dict[str, float], motors: tuple[float, ...], forces: tuple[float, ...]
) -> None:
    torch.testing.assert_close(force_curve(at(*motors), make_cart(len(motors), **changes)), at(*forces))


def test_newtons_ignore_the_parameters_of_the_cart(make_cart: MakeCart) -> None:
    cart = make_cart(9, force_linear=0.5, force_asymmetry=0.3, deadband_left=200.0)
    torch.testing.assert_close(newtons(LEVELS, cart), NEWTONS)


class TestLag:
    @pytest.mark.parametrize("time_constant", [0.001, 0.01, 0.1])
    def test_is_the_analytic_solution(self, time_constant: float) -> None:
        step = 0.02
        mean, end = lag_shares(at(time_constant), step)
        assert end.item() == pytest.approx(math.exp(-step / time_constant))
        time = (torch.arange(200_000, dtype=torch.float64) + 0.5) * step / 200_000
        assert mean.item() == pytest.approx(torch.exp(-time / time_constant).mean().item(), rel=1e-6)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_none_without_a_time_constant(self, dtype: torch.dtype) -> None:
        mean, end = lag_shares(at(0.0).to(dtype), 0.01)
        assert mean.item() == pytest.approx(0.0, abs=1e-9)
        assert end.item() == 0.0


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
    @pytest.mark.parametrize("periods", [0.5, 1.7])
    def test_latency_equals_later_commands(self, make_cart: MakeCart, periods: float, actuator: Law) -> None:
        period, substeps, count = 0.02, 10, 40
        step, cart = period / substeps, make_cart()
        generator = torch.Generator().manual_seed(0)
        commands = 50.0 * torch.randint(-5, 6, (count, 1), generator=generator).to(torch.float64)
        models = Models.of(cart_friction="stribeck", actuator=actuator)
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
