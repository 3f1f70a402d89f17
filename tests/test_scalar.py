"""Plain arithmetic gives what the traced function gives, also for NaN, infinities, zeros and halves."""

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from operations import AWKWARD, OPERATIONS
from torch import Tensor

from cartpole_rl.choices import choice
from cartpole_rl.envs.perception import Previous, perceive, perceive_first
from cartpole_rl.envs.settings import ObservationSettings, TrackGuard
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.models import INTEGRATORS, Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import Carts, Inputs, run_carts
from cartpole_rl.plants.specs import PlantOutput
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.scalar import Scalar, plain
from cartpole_rl.tasks.features import ObservationKind
from cartpole_rl.tasks.rewards import Reward
from cartpole_rl.tasks.settings import RewardSettings, TaskSettings

numbers = st.sampled_from(AWKWARD) | st.floats(-10, 10)
GUARD = TrackGuard(margin=0.01, delay=0.05, deceleration=3.0)
TASK = TaskSettings(**choice("task/swingup") | {"x_max": 0.38, "time_limit": 500})
REWARD = RewardSettings(**choice("reward/score"))
quick = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def doubles() -> Iterator[None]:
    """PyTorch computes in float64 as Python does, so that results can be compared closely."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def check(function: Callable[..., Any], scalar: Scalar, *arguments: tuple[Tensor, ...]) -> None:
    """Compare `scalar` with the `function` that it was made of."""
    expected, result = function(*arguments), scalar(*(tuple(map(plain, each)) for each in arguments))
    assert type(result) is type(expected)
    for value, right in zip(result, expected, strict=True):
        assert len(value) == right.numel()
        kind = {torch.bool: bool, torch.int64: int}.get(right.dtype, float)
        for number, exact in zip(value, plain(right), strict=True):
            assert kind(number) == pytest.approx(exact, rel=1e-9, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("number", range(len(OPERATIONS)))
@quick
@given(a=numbers, b=numbers)
def test_an_operation_behaves_as_in_torch(number: int, a: float, b: float) -> None:
    def function(pair: tuple[Tensor, Tensor]) -> tuple[Tensor]:
        return (OPERATIONS[number](*pair),)

    pair = torch.tensor([a]), torch.tensor([b])
    check(function, Scalar(function, pair), pair)


@given(values=st.lists(numbers, min_size=6, max_size=6))
@quick
def test_shapes_are_followed(values: list[float]) -> None:
    def function(given: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        table, row = given
        first, second = table.unbind(0)
        newest = torch.cat((row, table))[: len(table)]
        parts = table.split([1, 1, 0])
        return newest, torch.stack((second, first)), parts[1], parts[2], table[0] + row[0, 1:].unsqueeze(0)

    given = torch.tensor(values[:4]).reshape(2, 2), torch.tensor([values[4:]])
    check(function, Scalar(function, given), given)


def test_one_tensor_may_be_the_example_of_two() -> None:
    example = torch.zeros(1)
    scalar = Scalar(lambda pair: (pair[0] - pair[1],), (example, example))
    assert scalar(((5.0,), (3.0,))) == ((2.0,),)


def test_an_unknown_operation_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"aten\.erf\.default"):
        Scalar(lambda values: (values[0].erf(),), (torch.zeros(1),))


def test_a_call_with_other_shapes_is_refused() -> None:
    scalar = Scalar(lambda values: (values[0] + 1,), (torch.zeros(2),))
    with pytest.raises(ValueError, match="unpack"):
        scalar(((1.0, 2.0, 3.0),))


def cart(draw: st.DrawFn) -> Carts:
    """A cart whose parameters lie anywhere near those of a real one, at any speed."""
    table = torch.tensor([[draw(st.floats(0.01, 2))] for _ in CartParameters.names()])
    motion = torch.tensor([[draw(st.floats(-8, 8) | st.sampled_from((0.0, math.nan)))] for _ in range(4)])
    return Carts(table, motion, torch.tensor([[draw(st.floats(-5, 5))], [200.0], [-90.0], [0.0]]))


MODELS = [Models(*each) for each in itertools.product(CART_FRICTIONS, POLE_FRICTIONS, ACTUATORS)]
DYNAMICS = list(itertools.product(INTEGRATORS, (False, True)))  # integrator, and whether the pole presses


@pytest.mark.parametrize("number", range(len(MODELS)), ids=lambda number: "-".join(MODELS[number][:3]))
def test_physics_is_that_of_many_carts(number: int) -> None:
    integrator, pole_presses = DYNAMICS[number % len(DYNAMICS)]
    models = MODELS[number]._replace(integrator=integrator, pole_presses=pole_presses)
    run = partial(run_carts, models=models, period=0.02, substeps=2, encoders=nominal_encoders())
    inputs = Inputs(torch.tensor([[0]]), torch.tensor([[0.5], [1.0], [-1.0]]))
    scalar = Scalar(run, Carts(torch.zeros(len(CartParameters.names()), 1), *torch.zeros(2, 4, 1)), inputs)

    @settings(max_examples=20, deadline=None)
    @given(present=st.composite(cart)(), motor=st.integers(-255, 255))
    def compare(present: Carts, motor: int) -> None:
        check(run, scalar, present, inputs._replace(motor=torch.tensor([[motor]])))

    compare()


@pytest.mark.parametrize("guard", [None, GUARD], ids=["no guard", "guard"])
@pytest.mark.parametrize("kind", ObservationKind)
@pytest.mark.parametrize("reward", Reward)
def test_perception_is_that_of_many_carts(
    reward: Reward, kind: ObservationKind, guard: TrackGuard | None
) -> None:
    memory = list(Reward).index(reward) % 3
    observation = ObservationSettings(
        kind=kind, past_motors=memory, past_velocities=memory, past_positions=memory, pole_length=memory > 1
    )
    task = TASK.model_copy(update={"angle_limit": 0.2 if memory else None, "time_limit": 3})
    rewards = REWARD.model_copy(update={"kind": reward, "position_cost": 0.1})
    encoders = nominal_encoders()
    later = partial(
        perceive, settings=observation, task=task, rewards=rewards, guard=guard, encoders=encoders
    )

    def first(frame: PlantOutput[Tensor], cart: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        return perceive_first(frame, *cart, settings=observation, guard=guard, encoders=encoders)

    length = torch.full((int(memory > 1), 1), 0.6)
    counts, flags, motor = st.integers(-(2**30), 2**30), st.booleans(), st.integers(-255, 255)
    previous = st.builds(
        Previous,
        columns(2, counts),
        columns(4, numbers),
        columns(observation.past_size, numbers),
        columns(1, st.integers(0, 3)),
        columns(1, motor),
        st.just(length),
        columns(1, st.sampled_from((0.4, math.inf))),
    )
    dt = st.sampled_from((0.0, 0.02, math.nan, 1.0))
    parts = columns(2, counts), columns(1, dt), columns(1, motor), columns(1, flags), columns(1, flags)
    frame = st.builds(PlantOutput, *parts)
    scalars: list[Scalar] = []

    @settings(max_examples=20, deadline=None)
    @given(previous=previous, frame=frame)
    def compare(previous: Previous[Tensor], frame: PlantOutput[Tensor]) -> None:
        cart = length, previous.track_end
        if not scalars:
            scalars.extend((Scalar(first, frame, cart), Scalar(later, previous, frame)))
        check(first, scalars[0], frame, cart)
        check(later, scalars[1], previous, frame)

    compare()


def columns(size: int, values: st.SearchStrategy[Any]) -> st.SearchStrategy[Tensor]:
    """Columns [size, 1]."""
    empty = torch.zeros(0, 1)
    if size == 0:
        return st.just(empty)
    return st.lists(values, min_size=size, max_size=size).map(lambda each: torch.tensor(each).unsqueeze(1))
