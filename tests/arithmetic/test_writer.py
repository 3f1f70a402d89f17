"""Plain arithmetic gives what the traced function gives, also for NaN, infinities, zeros and halves."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import pytest
import torch
from operations import AWKWARD, OPERATIONS, PAIRS
from torch import Tensor

from cartpole_rl.arithmetic.writer import Scalar, plain
from cartpole_rl.choices import choice
from cartpole_rl.envs.perception import Previous, guarded, perceive, perceive_first
from cartpole_rl.envs.settings import GuardedPole, ObservationSettings, TrackGuard
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.models import INTEGRATORS, Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import Carts, Inputs, run_carts
from cartpole_rl.plants.specs import PlantOutput
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.tasks.features import Measured, ObservationKind
from cartpole_rl.tasks.rewards import Reward
from cartpole_rl.tasks.settings import RewardSettings, TaskSettings

CARTS = 100
GUARD = TrackGuard(margin=0.01, delay=0.05, deceleration=3.0)
TASK = TaskSettings(**choice("task/swingup") | {"x_max": 0.38, "time_limit": 500})
REWARD = RewardSettings(**choice("reward/score"))


@pytest.fixture(autouse=True)
def doubles() -> Iterator[None]:
    """PyTorch computes in float64 as Python does, so that results can be compared closely."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(before)


def column(arguments: tuple[Tensor, ...], number: int) -> tuple[Tensor, ...]:
    """One cart of many: the tensors [k, 1] of tensors [k, N]."""
    parts = [each[:, number : number + 1] for each in arguments]
    return arguments._make(parts) if hasattr(arguments, "_make") else tuple(parts)


def check(function: Callable[..., tuple[Tensor, ...]], *arguments: tuple[Tensor, ...]) -> None:
    """Compare a `Scalar` of one cart, for each in turn, with the `function` of all carts: tensors [k, N]."""
    scalar = Scalar(function, *(column(each, 0) for each in arguments))
    expected = function(*arguments)
    results = [
        scalar(*(tuple(map(plain, column(each, number))) for each in arguments))
        for number in range(arguments[0][0].shape[1])
    ]
    assert type(results[0]) is type(expected)
    for part, right in enumerate(expected):
        found = np.array([result[part] for result in results], right.numpy().dtype).T
        assert found == pytest.approx(right.numpy(), rel=1e-9, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("operation", OPERATIONS, ids=range(len(OPERATIONS)))
def test_an_operation_behaves_as_in_torch(operation: Callable[[Tensor, Tensor], Tensor]) -> None:
    check(lambda pair: (operation(*pair),), tuple(torch.tensor(PAIRS).T.unsqueeze(1)))


def test_shapes_are_followed() -> None:
    def function(given: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        table, row = given
        first, second = table.unbind(0)
        newest = torch.cat((row, table))[: len(table)]
        parts = table.split([1, 1, 0])
        halves = (*table.chunk(2), row[:, ::2])
        return (
            newest,
            torch.stack((second, first)),
            parts[1],
            parts[2],
            table[0] + row[0, 1:].unsqueeze(0),
            *halves,
        )

    given = torch.arange(4.0).reshape(2, 2), torch.tensor([[math.nan, -math.inf]])
    result, expected = Scalar(function, given)(tuple(map(plain, given))), function(given)
    for values, right in zip(result, expected, strict=True):
        assert values == pytest.approx(plain(right), nan_ok=True)


def test_one_tensor_may_be_the_example_of_two() -> None:
    example = torch.zeros(1)
    scalar = Scalar(lambda pair: (pair[0] - pair[1],), (example, example))
    assert scalar(((5.0,), (3.0,))) == ((2.0,),)


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (lambda values: (values[0].erf(),), "erf"),
        (lambda values: (values[0].to(torch.uint8),), "_to_copy"),  # wraps
        (lambda values: (values[0].half(),), "_to_copy"),  # rounds
        (lambda values: values[0].sort()[:1], "sort"),
    ],
)
def test_an_unknown_operation_is_named(function: Callable[..., tuple[Tensor, ...]], name: str) -> None:
    with pytest.raises(NotImplementedError, match=rf"aten\.{name}\.default"):
        Scalar(function, (torch.zeros(1),))


def test_a_call_with_other_shapes_is_refused() -> None:
    scalar = Scalar(lambda values: (values[0] + 1,), (torch.zeros(2),))
    with pytest.raises(ValueError, match="unpack"):
        scalar(((1.0, 2.0, 3.0),))


def drawn(rows: int, low: float, high: float, awkward: Sequence[float] = ()) -> Tensor:
    """Numbers [rows, CARTS] between two bounds; half of them are `awkward` ones, where there are such."""
    values = torch.empty(rows, CARTS).uniform_(low, high)
    if not awkward:
        return values
    chosen = torch.tensor(awkward)[torch.randint(len(awkward), (rows, CARTS))]
    return torch.where(torch.rand(rows, CARTS) < 0.5, chosen, values)


KINDS = [list(kind) for kind in (CART_FRICTIONS, POLE_FRICTIONS, ACTUATORS, INTEGRATORS)]
MODELS = [Models(*(laws[number % len(laws)] for laws in KINDS), number % 3 == 0) for number in range(10)]


@pytest.mark.parametrize("models", MODELS, ids=lambda models: "-".join(models[:3]))
def test_physics_is_that_of_many_carts(models: Models) -> None:
    """Of carts whose parameters lie anywhere near those of a real one, at any speed."""
    run = partial(run_carts, models=models, period=0.02, substeps=2, encoders=nominal_encoders())
    drive = torch.cat((drawn(1, -5, 5), torch.tensor([200.0, -90.0, 0.0]).unsqueeze(1).expand(3, CARTS)))
    carts = Carts(drawn(len(CartParameters.names()), 0.01, 2), drawn(4, -8, 8, (0.0, math.nan)), drive)
    noise = torch.tensor([[0.5], [1.0], [-1.0]]).expand(3, CARTS)
    check(run, carts, Inputs(torch.randint(-255, 256, (1, CARTS)), noise))


POLES = [GuardedPole(swing=0.8, density=0.4, length=length) for length in (0.6, None)]
GUARDS = [GUARD.model_copy(update={"pole": pole}) for pole in POLES]


@pytest.mark.parametrize("guard", [*GUARDS, GUARDS[0].model_copy(update={"also": GUARDS[1]})])
def test_a_guard_that_knows_the_pole_is_that_of_many_carts(guard: TrackGuard) -> None:
    def direction(given: tuple[Tensor, ...]) -> tuple[Tensor]:
        states, length, track_end = given
        return (guarded(Measured(*states), track_end, length, guard),)

    given = drawn(4, -1, 1), drawn(1, 0.1, 2, (math.nan, math.inf)), drawn(1, 0.4, 0.4, (math.inf,))
    assert set(direction(given)[0][0].tolist()) == {-1, 0, 1}
    check(direction, given)


OBSERVED = itertools.product(ObservationKind, range(3))  # with some of the past


@pytest.mark.parametrize(("number", "kind", "memory"), [(n, *each) for n, each in enumerate(OBSERVED)])
def test_perception_is_that_of_many_carts(number: int, kind: ObservationKind, memory: int) -> None:
    guard, reward = (None, GUARD)[number % 2], list(Reward)[number % len(Reward)]
    observation = ObservationSettings(
        kind=kind, past_motors=memory, past_velocities=memory, past_positions=memory, pole_length=memory > 1
    )
    task = TASK.model_copy(update={"angle_limit": 0.2 if memory else None, "time_limit": 3})
    rewards = REWARD.model_copy(update={"kind": reward, "position_cost": 0.1})
    rules = {"settings": observation, "guard": guard, "encoders": nominal_encoders()}

    def first(frame: PlantOutput[Tensor], cart: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        return perceive_first(frame, *cart, **rules, speed_periods=1 + memory)

    def counts() -> Tensor:
        return torch.randint(-(2**30), 2**30, (2, CARTS))

    def motor() -> Tensor:
        return torch.randint(-255, 256, (1, CARTS))

    previous = Previous(
        counts(),
        drawn(4, -10, 10, AWKWARD),
        drawn(observation.past_size, -10, 10, AWKWARD),
        drawn(memory, -10, 10, AWKWARD),
        torch.randint(4, (1, CARTS)),
        motor(),
        torch.full((int(memory > 1), CARTS), 0.6),
        drawn(1, 0.4, 0.4, (math.inf,)),
    )
    flags = torch.rand(2, 1, CARTS) < 0.5
    frame = PlantOutput(counts(), drawn(1, 0.02, 0.02, (0.0, math.nan, 1.0)), motor(), *flags)
    check(first, frame, (previous.length, previous.track_end))
    check(partial(perceive, task=task, rewards=rewards, **rules), previous, frame)
