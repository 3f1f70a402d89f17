"""For any behaviour of a cart: all observations are finite, and all motor values are valid.

Hypothesis scripts the cart: counts, clock, ticks, flags, faults and acknowledgements are arbitrary, and so
are the values by which the policy chooses. The wire is a real pseudo-terminal.
"""

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from serial_peer import CartPeer
from tensordict import TensorDictBase

from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.physics.dynamics import State as TrueState
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Flags, SetMotor, Start, State

MOTORS = (-255, -100, 0, 255)
PERIODS = 12
RELAXED = settings(
    max_examples=10,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
QUICK = {
    "timeout": 0.1,
    "connect_timeout": 1.0,
    "answer_timeout": 0.05,
    "retries": 0,
    "nudge_after": 0.02,
    "start_timeout": 1.0,
    "home_timeout": 1.0,
}

u32, i32 = st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1)
sane = st.just(None)  # as a sound cart has it
said = st.fixed_dictionaries(
    {
        "ticks": st.sampled_from([1, 1, 1, 1, 2, 0, -1, 40, 2**31]),  # from one state to the next
        "time_us": sane | st.sampled_from([0, 1, -1, 2**31]) | u32,  # passed since the last state
        "cart_counts": sane | i32,
        "pole_counts": sane | i32,
        "fault": sane | sane | st.integers(0, 2**16 - 1),
        "flags": sane | sane | st.integers(0, 63),
        "motor_applied": sane | st.integers(-(2**15), 2**15 - 1),
        "last_sequence": sane | sane | st.integers(0, 255),
    }
)
value = st.one_of(*4 * [st.floats(-1, 1, width=32)], st.floats(width=32))
values = st.lists(value, min_size=len(MOTORS), max_size=len(MOTORS))


@dataclass
class Script:
    """The script of an episode: the cart's reports and the policy's action values."""

    states: list[dict[str, int | None]]
    values: list[list[float]]


SOUND = {"ticks": 1} | dict.fromkeys(
    ("time_us", "cart_counts", "pole_counts", "fault", "flags", "motor_applied", "last_sequence")
)
scripts = st.builds(  # sound states first, so that the rest is said in every period of an episode
    Script,
    st.tuples(st.integers(0, PERIODS), st.lists(said, min_size=1, max_size=PERIODS)).map(
        lambda parts: parts[0] * [SOUND] + parts[1]
    ),
    st.lists(values, min_size=PERIODS, max_size=PERIODS),
)


class ScriptedCart(CartPeer):
    """A cart that behaves until it is armed, then reports what the script contains."""

    def __init__(self, script: Script) -> None:
        super().__init__()
        self._coming = iter(script.states)

    def answer(self, frame: Frame) -> Iterable[bytes]:
        yield from super().answer(frame)
        if isinstance(frame.message, Start):
            self.next_state = self.scripted

    def scripted(self) -> bytes:
        """The next state of the script, and sound ones after its end."""
        script = next(self._coming, None)
        if script is None:
            return CartPeer.next_state(self)
        passed = self.info.period_us if script["time_us"] is None else script["time_us"]
        changes = {
            key: script[key]
            for key in ("cart_counts", "pole_counts", "fault", "motor_applied", "last_sequence")
            if script[key] is not None
        }
        self.state = replace(
            self.state,
            tick=(self.state.tick + script["ticks"]) % 2**32,
            time_us=(self.state.time_us + passed) % 2**32,
        )
        state: State = replace(self.state, **changes)
        return self.encode(state, self.flags if script["flags"] is None else Flags(script["flags"]))


class Policy:
    """Chooses by the script's values, and keeps what it saw."""

    def __init__(self, script: Script) -> None:
        self._values = script.values
        self.seen: list[torch.Tensor] = []

    def __call__(self, present: TensorDictBase) -> TensorDictBase:
        value = torch.tensor(self._values[len(self.seen) % PERIODS]).expand(len(present), -1)
        self.seen.append(present["observation"].clone())
        return present.set("action_value", value).set("action", value.argmax(-1))


@RELAXED
@given(script=scripts)
def test_a_serial_cart_with_arbitrary_reports(script: Script, make_environment: Callable) -> None:
    with ScriptedCart(script) as peer:
        plant = SerialPlant(SerialSettings(port=peer.port).model_copy(update=QUICK))
        env = make_environment(plant, MOTORS, time_limit=PERIODS)
        policy, episode = Policy(script), None
        try:
            with suppress(PlantError):  # a reset may rightly fail
                (episode,) = run_batch(env, policy)
                ended_at = len(peer.received)
                drive_on(env)
        finally:
            env.close()
        sent = [frame.message.motor for frame in peer.received if isinstance(frame.message, SetMotor)]
        assert all(seen.isfinite().all() for seen in policy.seen)
        assert all(abs(motor) <= peer.info.motor_limit for motor in sent)
        assert not sent or sent[-1] == 0
        if episode is not None:
            assert_sound(episode)
            assert not any(getattr(frame.message, "motor", 0) for frame in peer.received[ended_at:])
            finite = [all(map(math.isfinite, script.values[row])) for row in range(episode.steps)]
            assert all(motor == 0 or known for motor, known in zip(driving(peer), finite, strict=False))


def drive_on(env: Any) -> None:
    """Drive on after the end of an episode."""
    present = env.fake_tensordict()
    for _ in range(3):
        env.step(present.set("action", torch.tensor([3])))


def driving(peer: CartPeer) -> list[int]:
    """The motor values that the host sent since it armed the cart, those of its end too."""
    messages = [frame.message for frame in peer.received]
    (start,) = (index for index, message in enumerate(messages) if isinstance(message, Start))
    return [message.motor for message in messages[start:] if isinstance(message, SetMotor)]


def assert_sound(episode: Any) -> None:
    """All numbers of an episode are finite, and its time increases."""
    for name in ("time", "x", "x_dot", "theta", "theta_dot", "score", "score_upright", "reward"):
        assert all(map(math.isfinite, getattr(episode, name))), name
    assert (episode.time[1:] > episode.time[:-1]).all()


anything = st.floats(width=32) | st.floats(-1, 1, width=32)


@RELAXED
@given(
    motions=st.lists(st.tuples(anything, anything, anything, anything), min_size=1, max_size=4),
    values=st.lists(values, min_size=PERIODS, max_size=PERIODS),
)
def test_a_simulated_cart_in_any_state(
    motions: list[tuple[float, ...]],
    values: list[list[float]],
    make_plant: Callable,
    make_environment: Callable,
) -> None:
    plant = make_plant(len(motions))
    env = make_environment(plant, MOTORS, time_limit=PERIODS)
    policy = Policy(Script([], values))

    def misplaced(present: TensorDictBase) -> TensorDictBase:
        if len(policy.seen) == 2:
            plant.place(TrueState(*torch.tensor(motions).T))
        return policy(present)

    for episode in run_batch(env, misplaced):
        assert_sound(episode)
        assert (abs(episode.motor) <= max(MOTORS)).all()
    assert all(seen.isfinite().all() for seen in policy.seen)
