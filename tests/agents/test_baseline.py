"""Energy and LQR: a stable regulator, correct decoding and prediction of the state, and the whole task."""

from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch
from courses import scattered
from tensordict import TensorDict

from cartpole_rl.agents.baseline import EnergyAndRegulator, decode, linearized, regulator
from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.physics.dynamics import State
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.tasks.episode import is_upright
from cartpole_rl.tasks.features import Measured, ObservationKind, observe

PERIOD = 0.02
MOTORS = tuple(choice("actions/nine_levels")["motors"])


def poles(name: str) -> PoleSettings:
    return PoleSettings(**choice(f"pole/{name}"))


def baseline(
    ip02: dict[str, float], pole: str, kind: ObservationKind = ObservationKind.COS_SIN, **changes: Any
) -> EnergyAndRegulator:
    settings = {"motors": MOTORS, "kind": kind, "past_motors": 3, "period": PERIOD, **changes}
    return EnergyAndRegulator({**ip02, **poles(pole).nominal.model_dump()}, Models(), **settings)


def table(ip02: dict[str, float], pole: str) -> torch.Tensor:
    nominal = {**ip02, **poles(pole).nominal.model_dump()}
    return torch.tensor([[nominal[name]] for name in CartParameters.names()], dtype=torch.float64)


@pytest.mark.parametrize("pole", ["medium", "large"])
def test_the_regulator_makes_upright_stable(ip02: dict[str, float], pole: str) -> None:
    cart = table(ip02, pole)
    transition, effect = linearized(cart, Models(), PERIOD)
    assert np.abs(np.linalg.eigvals(transition)).max() > 1.05  # left alone, the pole falls
    gain = regulator(cart, Models(), PERIOD)
    assert np.abs(np.linalg.eigvals(transition - effect @ gain[None])).max() < 0.99


@pytest.mark.parametrize("kind", [ObservationKind.RAW, ObservationKind.COS_SIN])
def test_decoding_inverts_the_observation(kind: ObservationKind) -> None:
    state = Measured(*torch.tensor([[0.1, -0.2], [-0.5, 0.7], [3.0, -1.2], [4.0, -9.0]]))
    motors = torch.tensor([[200.0, 0.0], [-150.0, 50.0]])
    seen = torch.cat((torch.stack(observe(state, kind), 1), motors / 255), 1)
    found, motor = decode(seen, kind)
    torch.testing.assert_close(torch.stack(found), torch.stack(state))
    torch.testing.assert_close(motor, motors[:, 0])


def test_predictions_match_the_simulation(
    ip02: dict[str, float], make_plant: Callable[..., SimulatedPlant]
) -> None:
    """Measured velocities are half a period old; predicted ones are those when the command takes effect."""
    plant = make_plant(1, cart={"latency": 0.0, "track_half_length": 2.0})
    plant.reset()
    plant.place(State(*torch.tensor([[0.0], [0.3], [0.8], [2.0]])))
    before = plant.true_state
    plant.step(TensorDict({"motor": torch.tensor([[250]])}, [1]))
    after = plant.true_state
    turned, moved = (after.theta - before.theta) / PERIOD, (after.x - before.x) / PERIOD
    velocities = {"x_dot": moved, "theta_dot": turned}
    policy = baseline({**ip02, "latency": 0.0}, "medium")
    expected = policy.predict(after._replace(**velocities), torch.tensor([250.0]))
    for name, measured in velocities.items():
        truth, led_on = getattr(after, name), getattr(expected, name)
        assert abs(led_on - truth) < 0.5 * abs(measured - truth)


def test_it_brakes_before_the_end_of_the_track(ip02: dict[str, float]) -> None:
    policy = baseline(ip02, "medium")
    x, x_dot = torch.tensor([0.33, -0.33, 0.1, 0.1]), torch.tensor([1.0, -1.0, 2.0, 0.1])
    hanging, still = torch.full((4,), 3.0), torch.zeros(4)
    force = policy.force(State(x, x_dot, hanging, still))
    assert force[:3].tolist() == [-policy.strongest, policy.strongest, -policy.strongest]
    assert abs(force[3]) < policy.strongest * 2


@pytest.mark.parametrize(("pole", "score"), [("medium", 3300), ("large", 2900)])
def test_it_swings_up_and_balances_the_simulated_cart(
    pole: str, score: float, ip02: dict[str, float], simulated: Callable[..., CartPoleEnv]
) -> None:
    env = simulated(20, {"poles": poles(pole), "start": scattered(position_spread=0.1)}, motors=MOTORS)
    episodes = run_batch(env, baseline(ip02, pole))
    assert {episode.ended_by for episode in episodes} == {"time"}
    assert all(is_upright(episode.theta[-100:]).all() for episode in episodes)
    assert min(episode.score.sum() for episode in episodes) > score


@pytest.mark.nightly  # commands/test_record.py: it keeps the large pole up on the emulated cart
@pytest.mark.parametrize(("pole", "score"), [("medium", 3000), ("large", 2600)])
def test_it_swings_up_and_balances_the_emulated_cart(
    pole: str, score: float, ip02: dict[str, float], make_environment: Callable[..., CartPoleEnv]
) -> None:
    truth = choice("emulator/large") if pole == "large" else {}
    truth.pop("defaults", None)
    plant = emulated_plant(EmulatorSettings(**truth, physics_step=1e-3))
    with closing(make_environment(plant, MOTORS)) as env:
        (episode,) = run_batch(env, baseline(ip02, pole))
    assert episode.ended_by == "time"
    assert is_upright(episode.theta[-100:]).all()
    assert episode.score.sum() > score


def test_a_cart_that_no_gain_balances_is_an_error(ip02: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="run=lqr: no regulator balances this cart; check the masses"):
        baseline({**ip02, "cart_viscous": 1e6}, "medium")


@pytest.mark.parametrize(
    "changes", [{"kind": ObservationKind.POSITIONS}, {"past_motors": 0}], ids=["positions", "no motors"]
)
def test_missing_observations_are_an_error(ip02: dict[str, float], changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="the baseline reads velocities and the last motor value"):
        baseline(ip02, "medium", **changes)
