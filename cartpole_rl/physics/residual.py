"""The learned residual: a force on the cart and an angular acceleration of the pole, added to the physics.

An ensemble of M members with two parts each: a table of forces along the track, for effects of position
(gears, a dent in the rail), and a small network of the motion and the pending motor values, for all others.
Both act within the integration, before friction, so a sticking cart stays at rest. Weights of zero change
nothing.
"""

from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import Addition, Drive, MakeAddition, State

UNDER_WAY = 4  # motor values that the network reads, newest first
INPUTS = 6 + UNDER_WAY
PLACES = 211  # entries of a table
SPACING = 0.004  # m between entries; the middle one is the middle of the track
UNITS = (0.5, 2.0)  # N and rad/s^2 per unit of output


class Residual(NamedTuple):
    """M members, each with a table and a network with two hidden layers of H units."""

    places: Tensor  # [M, PLACES] in UNITS[0]
    first: Tensor  # [M, H, INPUTS]
    first_bias: Tensor  # [M, H, 1]
    second: Tensor  # [M, H, H]
    second_bias: Tensor  # [M, H, 1]
    last: Tensor  # [M, 2, H]

    @classmethod
    def untrained(cls, members: int, hidden: int, generator: torch.Generator) -> Self:
        """Return members that differ and do not add anything yet."""

        def drawn(*shape: int) -> Tensor:
            return torch.randn(shape, generator=generator) * shape[-1] ** -0.5

        return cls(
            torch.zeros(members, PLACES),
            drawn(members, hidden, INPUTS),
            0.5 * drawn(members, hidden, 1),
            drawn(members, hidden, hidden),
            0.5 * drawn(members, hidden, 1),
            torch.zeros(members, 2, hidden),
        )

    @property
    def members(self) -> int:
        """M."""
        return len(self.places)

    def as_type(self, dtype: torch.dtype) -> Self:
        """Return the same numbers in another type."""
        return type(self)(*(weight.to(dtype) for weight in self))

    def as_float(self) -> Self:
        """Return the same numbers in float32, detached."""
        return type(self)(*(weight.detach().float() for weight in self))

    def network(self, inputs: Tensor) -> Tensor:
        """Return outputs [M, 2, N] in UNITS for `inputs` [M, INPUTS, N] or [1, INPUTS, N] for all members."""
        inputs = inputs.expand(self.members, -1, -1)
        hidden = torch.tanh(self.first @ inputs + self.first_bias)
        return self.last @ torch.tanh(self.second @ hidden + self.second_bias)

    def place_force(self, x: Tensor, member: Tensor) -> Tensor:
        """Return the force of the tables of `member` [N] int64 at `x` [N] m, N, interpolated linearly."""
        at = (x / SPACING + PLACES // 2).clamp(0, PLACES - 1.001)
        below = at.detach().floor()
        share, index = at - below, member * PLACES + below.long()
        table = self.places.reshape(-1)
        low, high = table.gather(0, index), table.gather(0, index + 1)
        return UNITS[0] * (low + share * (high - low))


def chosen_members(residual: Residual, member: Tensor) -> MakeAddition:
    """Return the addition for carts of `member` [N] int64 each: all networks run; each cart uses its own."""

    def network(inputs: Tensor) -> Tensor:
        own = torch.arange(residual.members, device=member.device).unsqueeze(1) == member  # [M, N]
        return (residual.network(inputs.unsqueeze(0)) * own.unsqueeze(1)).sum(0)

    return adding(residual, network, member)


def members_in_turn(residual: Residual, each: int) -> MakeAddition:
    """Return the addition for M times `each` carts, the first member's first."""

    def network(inputs: Tensor) -> Tensor:
        by_member = inputs.reshape(INPUTS, residual.members, each).transpose(0, 1)
        return residual.network(by_member).transpose(0, 1).reshape(2, -1)

    return adding(residual, network, torch.arange(residual.members).repeat_interleave(each))


def adding(residual: Residual, network: Callable[[Tensor], Tensor], member: Tensor) -> MakeAddition:
    """Return the addition of `network`, inputs [INPUTS, N] to outputs [2, N], and of the members' tables."""

    def addition(state: State, drive: Drive) -> Addition:
        push, turn = network(network_inputs(state, drive)).unbind(0)
        return Addition(UNITS[0] * push, lambda x: residual.place_force(x, member), UNITS[1] * turn)

    return addition


def network_inputs(state: State, drive: Drive) -> Tensor:
    """Return the inputs of the network, each about 1 in size, [INPUTS, N]; `drive` has UNDER_WAY motors."""
    x, x_dot, theta, theta_dot = state
    motors = [motor / 200 for motor in drive.motors[:UNDER_WAY]]
    return torch.stack(
        (x / 0.4, x_dot, torch.sin(theta), torch.cos(theta), theta_dot / 8, drive.force / 4, *motors)
    )
