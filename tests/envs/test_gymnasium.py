"""By Gymnasium's rules: its checker is content, seeds repeat, and one cart does what a batch of one does."""

import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, VectorEnv

from cartpole_rl import ENVIRONMENTS, MAX_EPISODE_STEPS, register
from cartpole_rl.choices import choice
from cartpole_rl.envs.gymnasium import PERIOD, simulated_environment
from cartpole_rl.envs.gymnasium_vector import CartPoleVector
from cartpole_rl.errors import ConfigError

STEPS, LIMIT = 130, 50
ONE_COUNT = 0.01  # of an encoder, in an observation: where float32 rounds it otherwise


def test_importing_registers_once() -> None:
    known = {name: gymnasium.registry[name] for name in ENVIRONMENTS}
    register()
    assert {name: gymnasium.registry[name] for name in ENVIRONMENTS} == known
    with gymnasium.make("cartpole_rl:cartpole_rl/Balance-v0") as env:
        assert env.spec is not None
        assert env.spec.id == "cartpole_rl/Balance-v0"


SCRIPT = """
import sys, cartpole_rl
assert 'gymnasium' not in sys.modules
sys.modules['gymnasium.core'] = None
try:
    import gymnasium
except ImportError:
    del sys.modules['gymnasium.core']
import torchrl.envs, gymnasium, torch
from cartpole_rl.envs import guard
guard.SAMPLES //= 8
torch.set_num_threads(2)
print(sorted(name for name in gymnasium.registry if 'cartpole' in name))
envs = gymnasium.make_vec("cartpole_rl/Balance-v0", 1, "async", vector_kwargs={"context": "fork"})
envs.reset(seed=0)
assert envs.step(envs.action_space.sample())[0].shape == (1, 10)
envs.close()
"""


def test_gymnasium_may_come_late_and_processes_can_be_forked() -> None:
    """Checking whether Gymnasium is installed, as TorchRL does, does not import it. An import may fail first.

    Fitting the guard starts no threads: in a process that is forked from one with threads torch blocks.
    """
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, f"{sorted(ENVIRONMENTS)}\n"), done.stderr


def vector(name: str, carts: int = 8, **options: object) -> VectorEnv:
    return gymnasium.make_vec(name, num_envs=carts, vectorization_mode="vector_entry_point", **options)


def course(env: VectorEnv, seed: int) -> Iterator[tuple]:
    """The reset and the steps under actions of the seed."""
    yield env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(STEPS):
        yield env.step(env.action_space.sample())


def test_passes_both_checkers_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a display, test_rendering.py checks the swing-up and its windows too."""
    monkeypatch.setattr("cartpole_rl.envs.gymnasium.has_display", bool)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity.*")  # a measured state has no bounds
        check_env(gymnasium.make("cartpole_rl/Balance-v0").unwrapped)
        env_checker = pytest.importorskip("stable_baselines3.common.env_checker")
        env_checker.check_env(gymnasium.make("cartpole_rl/SwingUp-v0"))


@pytest.mark.parametrize(("name", "actions", "limit"), [("SwingUp", 9, None), ("Balance", 3, np.radians(12))])
def test_the_tasks_are_those_of_conf(name: str, actions: int, limit: float | None) -> None:
    env = gymnasium.make(f"cartpole_rl/{name}-v0").unwrapped
    assert env.action_space.n == actions
    assert env.env.hardware.task.angle_limit == pytest.approx(limit)
    assert env.env.plant.parameters.pole_com.item() == pytest.approx(0.1778)
    assert env.env.hardware.task.x_max == pytest.approx(env.env.plant.parameters.track_half_length.item())


def test_the_constants_are_those_of_conf() -> None:
    assert choice("train")["control_period"] == PERIOD
    assert {choice(f"task/{task}")["duration"] for task in ENVIRONMENTS.values()} == {
        MAX_EPISODE_STEPS * PERIOD
    }
    assert {gymnasium.spec(name).max_episode_steps for name in ENVIRONMENTS} == {MAX_EPISODE_STEPS}


def test_max_episode_steps_sets_the_length_of_an_episode() -> None:
    single = gymnasium.make("cartpole_rl/SwingUp-v0", max_episode_steps=510)
    many = vector("cartpole_rl/SwingUp-v0", carts=2, max_episode_steps=7)
    for env, steps, action in ((single, 510, 4), (many, 7, np.full(2, 4))):  # the middle action: no motor
        env.reset(seed=0)
        ends = [np.all(env.step(action)[3]) for _ in range(steps)]
        assert ends == [False] * (steps - 1) + [True]


@pytest.mark.parametrize("name", ENVIRONMENTS)
class TestVector:
    def test_spaces_hold_seeds_repeat_and_ended_episodes_restart(self, name: str) -> None:
        env = vector(name, randomization="wide", max_episode_steps=LIMIT)
        assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        first, again, other = (list(course(env, seed)) for seed in (1, 1, 2))
        observations, *others = (np.stack([each[0] for each in found]) for found in (first, again, other))
        assert (observations == others[0]).all()
        assert (observations != others[1]).any()
        assert all(env.observation_space.contains(each) for each in observations)
        ends = 0
        for observation, *outcome, info in first[1:]:
            assert [part.shape for part in outcome] == [(8,)] * 3
            assert [part.dtype for part in outcome] == [np.float32, np.bool_, np.bool_]
            ended = outcome[1] | outcome[2]
            assert (info.get("_final_obs", np.zeros(8, bool)) == ended).all()
            for row in np.flatnonzero(ended):
                assert env.single_observation_space.contains(info["final_obs"][row])
                assert (info["final_obs"][row] != observation[row]).any()
                ends += 1
        assert ends >= 16

    def test_does_not_touch_torchs_global_generator(self, name: str) -> None:
        env = vector(name)
        before = torch.random.get_rng_state()
        env.reset(seed=3)
        assert torch.equal(torch.random.get_rng_state(), before)

    def test_a_cart_in_a_batch_equals_a_single_cart(self, name: str) -> None:
        alone, batch = gymnasium.make(name), vector(name, carts=1)
        first = alone.reset(seed=5)[0], batch.reset(seed=5)[0][0]
        np.testing.assert_allclose(*first, rtol=1e-6)
        batch.action_space.seed(0)
        for _ in range(200):
            action = batch.action_space.sample()
            one, many = alone.step(action[0]), batch.step(action)
            np.testing.assert_allclose(one[1], many[1][0], atol=ONE_COUNT)
            assert one[2:4] == tuple(part[0] for part in many[2:4])
            if one[2] or one[3]:
                return
            np.testing.assert_allclose(one[0], many[0][0], atol=ONE_COUNT)


def test_randomization_is_by_name_or_by_lines() -> None:
    for given in ("wide", {"cart_mass": {"relative": [-0.2, 0.2]}}):
        env = simulated_environment("swingup", 8, given)
        env.reset()
        assert len(env.plant.parameters.cart_mass.unique()) == 8
    with pytest.raises(ConfigError, match="randomization=wild: there is no such choice; did you mean wide"):
        simulated_environment("swingup", 8, "wild")


CHOSEN = {"pole": "large", "observation": "raw", "actions": "three", "guard": "careful", "period": 0.025}


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_keyword_arguments_take_what_the_configuration_takes(make: Any) -> None:
    reward = {"defaults": ["score"], "scale": 2.0}
    env = make("cartpole_rl/SwingUp-v0", **CHOSEN, reward=reward).unwrapped
    copy = pickle.loads(pickle.dumps(env))
    for each in (env, copy):
        assert each.env.plant.pole_length.item() == pytest.approx(0.6604)
        assert each.env.plant.period == 0.025
        assert each.env.hardware.reward.scale == 2.5  # a period of 0.025 s in place of 0.02 s
        assert each.env.hardware.observation_settings.size == 4
        assert len(each.env.hardware.motors) == 3
        assert each.metadata["render_fps"] == 40
    assert (env.reset(seed=1)[0] == copy.reset(seed=1)[0]).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"pole": "larg"}, "pole=larg: there is no such choice; did you mean large"),
        ({"period": 0.5}, "control_period=0.5: give at most 0.1 s"),
        ({"period": "soon"}, "control_period=soon: give a number"),
        ({"cart": {"defaults": ["ip02"], "cart_mas": 1}}, "cart_mas: .* did you mean cart_mass"),
        ({"poles": "large"}, "poles: an environment has no such setting; did you mean pole"),
        ({"agent": "dqn"}, "agent: an environment has no such setting"),
    ],
)
def test_keyword_arguments_are_checked_as_the_configuration(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        gymnasium.make("cartpole_rl/SwingUp-v0", **given)


def test_one_cart_is_reset_first() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        gymnasium.make("cartpole_rl/SwingUp-v0").unwrapped.step(0)


def test_many_carts_are_reset_first_and_take_one_seed() -> None:
    envs = vector("cartpole_rl/SwingUp-v0", carts=2, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(2, int))
    with pytest.raises(ConfigError, match=r"seed=\[1, 2\]: give one integer"):
        envs.reset(seed=[1, 2])  # type: ignore[arg-type]
    envs.reset(options={"reset_mask": np.array([False, True])})  # the first one is of all
    assert len(envs.render()) == 2
    before = envs.reset(seed=3, options={"reset_mask": None})[0]
    for mask in ([True], np.zeros(2, bool), np.ones(2)):
        with pytest.raises(ConfigError, match="reset_mask: give 2 booleans, of which one is True at least"):
            envs.reset(options={"reset_mask": mask})
    after = envs.reset(options={"reset_mask": np.array([True, False])})[0]
    assert (before != after).any(axis=1).tolist() == [True, False]
    assert envs.step(np.full(2, 8))[0].shape == before.shape


def test_only_existing_actions_are_taken() -> None:
    one, many = gymnasium.make("cartpole_rl/SwingUp-v0"), vector("cartpole_rl/SwingUp-v0", carts=2)
    for env in (one, many):
        env.reset(seed=0)
    for action in (-1, 9, 2.0, True, [2]):
        for env, given, expected in ((one, action, "an integer"), (many, [action, action], "2 integers")):
            with pytest.raises(ConfigError, match=f"give {expected} from 0 to 8"):
                env.unwrapped.step(given)


@pytest.mark.parametrize("setting", ["max_episode_steps", "num_envs"])
@pytest.mark.parametrize("value", [0, 2.5, True])
def test_a_count_is_an_integer_of_at_least_one(setting: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=f"{setting}={value}: give an integer of at least 1"):
        CartPoleVector("swingup", **{setting: value})
