"""Publishes snapshots of the cart on a port while it is driven."""

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.snapshots import Memory, Snapshot, write


def followed(env: CartPoleEnv, memory: Memory | None) -> CartPoleEnv:
    """Return `env`, whose cart is published in `memory` from now on, if there is one."""
    if memory is not None:
        env.plant.on_command = Publisher(env, memory)
    return env


class Publisher:
    """Writes a snapshot to `memory` when it is called, each time a motor value has been sent to the cart."""

    def __init__(self, env: CartPoleEnv, memory: Memory) -> None:
        self._cart, self._statistics, self._memory = env.one_cart, env.plant.statistics, memory
        (self._track_half_length,) = env.plant.track_half_length.tolist()
        self._written = self._episode = 0
        self._score = 0.0

    def __call__(self, motor: int) -> None:
        """Write the state that the motor value was chosen on."""
        percept = self._cart.percept
        (step,), (guard,), (score,) = percept.step_count, percept.guard, percept.score
        if step == 0:
            self._episode += 1
            self._score = 0.0
        self._score += score
        self._written += 1
        statistics = self._statistics
        x, x_dot, theta, theta_dot = percept.state
        snapshot = Snapshot(
            self._episode,
            step,
            motor,
            guard,
            statistics.late_ticks,
            statistics.lost_frames,
            x,
            x_dot,
            theta,
            theta_dot,
            self._score,
            self._track_half_length,
        )
        write(self._memory, self._written, snapshot)
