"""The ceiling of adaptation: the informed agent observes the drawn parameters; wider ranges stay possible."""

import adaptation
import pytest
import torch
from adaptation import Job, make_env, wider_ranges

from cartpole_rl.randomization.ranges import check_carts
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.workflows.config import TrainConfig, load_settings


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    return load_settings(TrainConfig, {"compile": False})


@pytest.mark.parametrize("wider", adaptation.WIDTHS)
def test_wider_ranges_are_possible(config: TrainConfig, wider: float) -> None:
    ranges = wider_ranges(wider)
    check_carts(config.nominal_cart, config.pole, ranges)
    for name, line in config.ranges.items():
        (low, high), (lower, higher) = line.limits(), ranges[name].limits()
        assert lower <= low + 1e-9
        assert higher - high == pytest.approx(0) if wider == 0 else higher > high


def test_the_informed_agent_observes_its_own_cart_before_and_after_a_reset(config: TrainConfig) -> None:
    env = make_env(config, Job(0.0, 0, True), 50, config.task.start, 0)
    plain = config.observation.size
    current = env.reset()
    for _ in range(3):
        current["action"] = torch.zeros(50, dtype=torch.int64)
        stepped, current = env.step_and_maybe_reset(current)
        stepped["next", "done"][:10] = True
        current = env.advance(stepped)
        known = current["observation"][:, plain:]
        assert known.shape == (50, len(config.ranges))
        assert known.abs().max() <= 1 + 1e-4
        tilt = list(config.ranges).index("track_tilt")
        expected = env.plant.parameters.track_tilt / config.ranges["track_tilt"].limits()[1]
        torch.testing.assert_close(known[:, tilt], expected)
    assert env.observation_spec["observation"].shape[-1] == plain + len(config.ranges)


def test_parameters_that_change_sign_in_a_mirror_have_symmetric_ranges(config: TrainConfig) -> None:
    for name, line in config.ranges.items():
        low, high = line.limits()
        assert PARAMETERS[name].mirrored == (low == -high)
