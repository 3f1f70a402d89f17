"""What a learned model adds to the physics: a force on the cart and an angular acceleration of the pole.

Two parts, M of each: a table of forces along the track, for what depends on the place (gears, a dent in the
rail), and a small network of the motion and of the motor values under way, for all else. Both act within the
integration, in front of friction, so that a cart that sticks stays at rest. All zeros change nothing.
"""

from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor

from cartpole_rl.physics.actuator import lagged_force, mean_commands, static_force
from cartpole_rl.physics.dynamics import Drive, State, advance, mechanism
from cartpole_rl.physics.models import Actuator, Models
from cartpole_rl.physics.parameters import CartParameters

UNDER_WAY = 4  # motor values that the network reads, newest first
INPUTS = 6 + UNDER_WAY
PLACES = 211  # at which a member tells its force
SPACING = 0.004  # m between them; the middle one is the middle of the track
UNITS = (0.5, 2.0)  # N and rad/s^2: what an output of 1 stands for


class Residual(NamedTuple):
    """M members, each a table and a network of one hidden layer after another, of H units each."""

    places: Tensor  # [M, PLACES] in UNITS[0]
    first: Tensor  # [M, H, INPUTS]
    first_bias: Tensor  # [M, H, 1]
    second: Tensor  # [M, H, H]
    second_bias: Tensor  # [M, H, 1]
    last: Tensor  # [M, 2, H]

    @classmethod
    def untrained(cls, members: int, hidden: int, generator: torch.Generator) -> Self:
        """Members that differ, and add nothing yet."""

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
        """The same numbers in another type."""
        return type(self)(*(weight.to(dtype) for weight in self))

    def as_float(self) -> Self:
        """The same numbers in float32, apart from any learning."""
        return type(self)(*(weight.detach().float() for weight in self))

    def network(self, inputs: Tensor) -> Tensor:
        """Outputs [M, 2, N] in UNITS for `inputs` [M, INPUTS, N], [1, INPUTS, N] for all members alike."""
        inputs = inputs.expand(self.members, -1, -1)
        hidden = torch.tanh(self.first @ inputs + self.first_bias)
        return self.last @ torch.tanh(self.second @ hidden + self.second_bias)

    def place_force(self, x: Tensor, member: Tensor) -> Tensor:
        """Force of the table, N, of `member` [N] int64 at `x` [N] m, straight lines between its places."""
        at = (x / SPACING + PLACES // 2).clamp(0, PLACES - 1.001)
        below = at.detach().floor()
        share, index = at - below, member * PLACES + below.long()
        table = self.places.reshape(-1)
        low, high = table.gather(0, index), table.gather(0, index + 1)
        return UNITS[0] * (low + share * (high - low))


class Addition(NamedTuple):
    """What acts beside the physics."""

    network: Callable[[Tensor], Tensor]  # inputs [INPUTS, N] to outputs [2, N]
    place_force: Callable[[Tensor], Tensor]  # x [N] m to N [N]


def chosen_members(residual: Residual, member: Tensor) -> Addition:
    """The addition for carts of `member` [N] int64 each: all networks run, and each cart takes its own."""

    def network(inputs: Tensor) -> Tensor:
        own = torch.arange(residual.members, device=member.device).unsqueeze(1) == member  # [M, N]
        return (residual.network(inputs.unsqueeze(0)) * own.unsqueeze(1)).sum(0)

    return Addition(network, lambda x: residual.place_force(x, member))


def members_in_turn(residual: Residual, each: int) -> Addition:
    """The addition for M times `each` carts, the first member's first."""
    member = torch.arange(residual.members).repeat_interleave(each)

    def network(inputs: Tensor) -> Tensor:
        by_member = inputs.reshape(INPUTS, residual.members, each).transpose(0, 1)
        return residual.network(by_member).transpose(0, 1).reshape(2, -1)

    return Addition(network, lambda x: residual.place_force(x, member))


def network_inputs(state: State, drive: Drive) -> Tensor:
    """What the network reads, each about 1 in size, [INPUTS, N]."""
    x, x_dot, theta, theta_dot = state
    motors = [motor / 200 for motor in drive.motors[:UNDER_WAY]]
    return torch.stack(
        (x / 0.4, x_dot, torch.sin(theta), torch.cos(theta), theta_dot / 8, drive.force / 4, *motors)
    )


def run_corrected_period(
    state: State,
    drive: Drive,
    latency: Tensor,
    cart: CartParameters,
    models: Models,
    period: float,
    substeps: int,
    addition: Addition,
) -> tuple[State, Drive]:
    """One control period as `run_period` does it, with an `addition`; at least UNDER_WAY motor values."""
    step = period / substeps
    body = mechanism(cart)
    held = [static_force(motor, cart, models.actuator) for motor in drive.motors]
    push, turn = addition.network(network_inputs(state, drive)).unbind(0)
    force = drive.force
    for target in mean_commands(held, latency, period, substeps):
        if models.actuator is Actuator.NEWTONS:
            mean = force = target
        else:
            mean, force = lagged_force(force, target, cart.motor_time_constant, step)
        acting = mean + UNITS[0] * push + addition.place_force(state.x)
        state = turned(advance(state, acting, cart, body, models, step), UNITS[1] * turn, step)
    return state, Drive(force, drive.motors)


def turned(state: State, acceleration: Tensor, step: float) -> State:
    """The state after a further angular acceleration, rad/s^2, [N], for `step` s."""
    faster = step * acceleration
    return state._replace(theta=state.theta + step * faster, theta_dot=state.theta_dot + faster)
