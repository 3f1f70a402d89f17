"""The learned residual adds nothing while it is zero; otherwise it adds its tables and networks."""

from collections.abc import Callable

import pytest
import torch

from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import PLACES, Residual, chosen_members, members_in_turn

MakeCart = Callable[..., CartParameters]
STEP = Models.of(cart_friction="step")
SETTINGS = (STEP, 0.02, 4)


def residual(members: int = 2, changed: bool = True) -> Residual:
    generator = torch.Generator().manual_seed(0)
    made = Residual.untrained(members, 6, generator, 0.02, 4.0, 0.814).as_type(torch.float64)
    if not changed:
        return made
    return made._replace(
        places=torch.randn(members, PLACES, generator=generator, dtype=torch.float64),
        last=torch.randn(members, 2, 6, generator=generator, dtype=torch.float64),
    )


def motion(carts: int) -> tuple[State, Drive]:
    random = torch.Generator().manual_seed(1)
    draws = torch.rand(6, carts, generator=random, dtype=torch.float64) - 0.5
    motors = [200 * torch.sign(draws[5])] * residual().memory
    return State(0.6 * draws[0], 2 * draws[1], 6 * draws[2], 10 * draws[3]), Drive(6 * draws[4], motors)


def stacked(state: State, drive: Drive) -> torch.Tensor:
    return torch.stack((*state, drive.force))


def test_a_residual_of_zeros_changes_nothing(make_cart: MakeCart) -> None:
    cart, (state, drive) = make_cart(8, latency=0.013, motor_time_constant=0.005), motion(8)
    addition = members_in_turn(residual(changed=False), 4)
    plain = run_period(state, drive, cart.latency, cart, *SETTINGS)
    corrected = run_period(state, drive, cart.latency, cart, *SETTINGS, addition)
    assert torch.equal(stacked(*plain), stacked(*corrected))


def test_members_in_turn_are_the_members_chosen(make_cart: MakeCart) -> None:
    cart, (state, drive) = make_cart(8), motion(8)
    learned, member = residual(), torch.arange(2).repeat_interleave(4)
    in_turn, chosen = (
        run_period(state, drive, cart.latency, cart, *SETTINGS, addition)
        for addition in (members_in_turn(learned, 4), chosen_members(learned, member))
    )
    assert torch.allclose(stacked(*in_turn), stacked(*chosen), rtol=1e-12)
    exchanged = run_period(state, drive, cart.latency, cart, *SETTINGS, chosen_members(learned, 1 - member))
    assert not torch.allclose(stacked(*in_turn), stacked(*exchanged), rtol=1e-3)


def test_widened_members_differ_more_about_the_same_mean() -> None:
    state, drive = motion(1)
    both = State(*(each.repeat(2) for each in state))
    pushed = Drive(drive.force.repeat(2), [motor.repeat(2) for motor in drive.motors])
    ends = [
        chosen_members(residual()._replace(widening=torch.tensor(factor)), torch.tensor([0, 1]))(both, pushed)
        for factor in (1.0, 3.0)
    ]
    for narrow, wide in zip(*((each.force, each.force_at(both.x)) for each in ends), strict=True):
        assert wide.mean().item() == pytest.approx(narrow.mean().item())
        assert wide.diff().item() == pytest.approx(3 * narrow.diff().item())


def test_tables_are_interpolated_linearly() -> None:
    learned = residual()
    middle, member = PLACES // 2, torch.ones(5, dtype=torch.int64)
    x = learned.spacing * torch.tensor([3.0, 3.5, 4.0, 1e3, torch.nan], dtype=torch.float64)
    table = learned.units[0] * learned.places[1]
    force = learned.place_force(x, member)
    at, after = table[middle + 3], table[middle + 4]
    assert torch.allclose(force[:3], torch.stack((at, (at + after) / 2, after)))
    assert force[3].item() == pytest.approx(table[-1].item(), abs=0.01)  # beyond the end: that of the end
    assert force[4] == table[0]


def test_a_force_that_friction_holds_does_not_move_a_cart(make_cart: MakeCart) -> None:
    """A change of velocity, added after the physics, would move it."""
    zero = torch.zeros(1, dtype=torch.float64)
    hanging = State(zero, zero, zero + torch.pi, zero)
    still = residual(1, changed=False)
    learned = still._replace(places=torch.full_like(still.places, 0.4) / still.units[0])
    moved = {}
    for coulomb in (0.5, 0.3):
        cart = make_cart(cart_coulomb=coulomb)
        drive = Drive(zero, [zero] * learned.memory)
        after, _ = run_period(hanging, drive, cart.latency, cart, *SETTINGS, members_in_turn(learned, 1))
        moved[coulomb] = after.x_dot.item()
    assert moved[0.5] == 0
    pull = make_cart()
    mass = (pull.cart_mass + pull.pole_mass).item()
    assert 0.1 * 0.02 / mass < moved[0.3] < 0.1 * 0.02 / pull.cart_mass.item()  # the pole follows in part
