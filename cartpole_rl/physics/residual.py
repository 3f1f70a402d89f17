"""The learned residual: a force on the cart and an angular acceleration of the pole, added to the physics.

An ensemble of M members with two parts each: a table of forces along the track, for effects of position
(gears, a dent in the rail), and a small network of the motion and the pending motor values, for all others.
Both act within the integration, before friction, so a sticking cart stays at rest. Weights of zero change
nothing.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import Addition, Drive, MakeAddition, State

MEMORY, LEAST_MEMORY = 0.24, 4  # s and periods of motor values that the network reads
MOTION = 6  # inputs beside the motor values
PLACES = 211  # entries of a table
REACH = 1.032  # ends of a table, in half distances between the stops
FULL_FORCE = 8  # units of force at the largest motor value, about
TURN = 2.0  # rad/s^2, the unit of the pole's angular acceleration


class Residual(NamedTuple):
    """M members, each with a table and a network with two hidden layers of H units.

    The network reads I = MOTION + D inputs: the motion, and the last D motor values.
    """

    places: Tensor  # [M, PLACES] in units
    first: Tensor  # [M, H, I]
    first_bias: Tensor  # [M, H, 1]
    second: Tensor  # [M, H, H]
    second_bias: Tensor  # [M, H, 1]
    last: Tensor  # [M, 2, H]
    units: Tensor  # [2] N and rad/s^2 of an output of 1
    spacing: Tensor  # [] m between entries of a table; the middle one is the middle of the track
    widening: Tensor  # [] factor on the distances of the members' outputs from their mean

    @classmethod
    def untrained(
        cls,
        members: int,
        hidden: int,
        generator: torch.Generator,
        period: float,
        full_force: float,
        track_span: float,
    ) -> Self:
        """Return members that differ and do not add anything yet.

        They are for a cart with a control period of `period` s, a force of about `full_force` N at the
        largest motor value, and `track_span` m between the stops.
        """

        def drawn(*shape: int) -> Tensor:
            return torch.randn(shape, generator=generator) * shape[-1] ** -0.5

        return cls(
            torch.zeros(members, PLACES),
            drawn(members, hidden, MOTION + memory_periods(period)),
            0.5 * drawn(members, hidden, 1),
            drawn(members, hidden, hidden),
            0.5 * drawn(members, hidden, 1),
            torch.zeros(members, 2, hidden),
            torch.tensor((full_force / FULL_FORCE, TURN)),
            torch.tensor(REACH * track_span / (PLACES - 1)),
            torch.tensor(1.0),
        )

    @property
    def weights(self) -> tuple[Tensor, ...]:
        """The learned tensors: tables and networks."""
        return self[:-3]

    def with_weights(self, weights: Sequence[Tensor]) -> Self:
        """Return the same with other `weights`."""
        return type(self)(*weights, *self[len(weights) :])

    @property
    def members(self) -> int:
        """M."""
        return len(self.places)

    @property
    def memory(self) -> int:
        """D."""
        return self.first.shape[2] - MOTION

    def widened_places(self) -> Tensor:
        """Return the tables, [M, PLACES], moved away from their mean."""
        return torch.lerp(self.places.mean(0, keepdim=True), self.places, self.widening)

    def not_widened(self) -> Self:
        """Return the members as they were learned."""
        return self._replace(widening=torch.ones_like(self.widening))

    def as_type(self, dtype: torch.dtype) -> Self:
        """Return the same numbers in another type."""
        return type(self)(*(weight.to(dtype) for weight in self))

    def as_float(self) -> Self:
        """Return the same numbers in float32, detached."""
        return type(self)(*(weight.detach().float() for weight in self))

    def network(self, inputs: Tensor) -> Tensor:
        """Return outputs [M, 2, N] in units for `inputs` [M, I, N] or [1, I, N] for all members."""
        inputs = inputs.expand(self.members, -1, -1)
        hidden = torch.tanh(self.first @ inputs + self.first_bias)
        return self.last @ torch.tanh(self.second @ hidden + self.second_bias)

    def place_force(self, x: Tensor, member: Tensor) -> Tensor:
        """Return the force of the tables of `member` [N] int64 at `x` [N] m, N, interpolated linearly.

        NaN is taken for the left end: such a state stays NaN.
        """
        at = (x / self.spacing + PLACES // 2).nan_to_num().clamp(0, PLACES - 1.001)
        below = at.detach().floor()
        share, index = at - below, member * PLACES + below.long()
        table = self.places.reshape(-1)
        low, high = table.gather(0, index), table.gather(0, index + 1)
        return self.units[0] * (low + share * (high - low))


def chosen_members(residual: Residual, member: Tensor) -> MakeAddition:
    """Return the addition for carts of `member` [N] int64 each, widened: all networks run."""

    def network(inputs: Tensor) -> Tensor:
        own = torch.arange(residual.members, device=member.device).unsqueeze(1) == member  # [M, N]
        share = residual.widening * own + (1 - residual.widening) / residual.members
        return (residual.network(inputs.unsqueeze(0)) * share.unsqueeze(1)).sum(0)

    return adding(residual._replace(places=residual.widened_places()), network, member)


def members_in_turn(residual: Residual, each: int) -> MakeAddition:
    """Return the addition for M times `each` carts, the first member's first, not widened."""

    def network(inputs: Tensor) -> Tensor:
        by_member = inputs.reshape(len(inputs), residual.members, each).transpose(0, 1)
        return residual.network(by_member).transpose(0, 1).reshape(2, -1)

    return adding(residual, network, torch.arange(residual.members).repeat_interleave(each))


def adding(residual: Residual, network: Callable[[Tensor], Tensor], member: Tensor) -> MakeAddition:
    """Return the addition of `network`, inputs [I, N] to outputs [2, N], and of the members' tables."""

    def addition(state: State, drive: Drive) -> Addition:
        push, turn = network(network_inputs(state, drive, residual)).unbind(0)
        force, acceleration = residual.units
        return Addition(force * push, lambda x: residual.place_force(x, member), acceleration * turn)

    return addition


def network_inputs(state: State, drive: Drive, residual: Residual) -> Tensor:
    """Return the inputs of the network, each about 1 in size, [I, N]; `drive` has D motor values or more."""
    x, x_dot, theta, theta_dot = state
    far, strong = (PLACES - 1) / 2 * residual.spacing, FULL_FORCE * residual.units[0]
    motors = [motor / 200 for motor in drive.motors[: residual.memory]]
    return torch.stack(
        (x / far, x_dot, torch.sin(theta), torch.cos(theta), theta_dot / 8, drive.force / strong, *motors)
    )


def memory_periods(period: float) -> int:
    """Return the number of motor values that a network reads, at a control period in s."""
    return max(LEAST_MEMORY, round(MEMORY / period))
