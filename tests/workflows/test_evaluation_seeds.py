"""No evaluation drives the carts, or begins at the starts, with which a training of a nearby seed began."""

from contextlib import closing

import pytest
import torch
from tensordict import TensorDictBase

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.settings import NUM_SEEDS, evaluation_seed
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings
from cartpole_rl.workflows.train import judge, nominal_env

CARTS = 64
SAME_STARTS = {
    "task.evaluation_start": choice("task/swingup")["start"],
    "learning.evaluation_episodes": CARTS,
    "compile": False,
}


def training(seed: int, **overrides: object) -> TrainConfig:
    """A training whose evaluations start as its episodes do: equal seeds would give equal starts."""
    return load_settings(TrainConfig, {**SAME_STARTS, "learning.carts": CARTS, "seed": seed, **overrides})


def begun(env: CartPoleEnv) -> set[tuple[float, ...]]:
    """Parameters and start of each cart after a reset, a row a cart."""
    env.reset()
    carts = env.plant.snapshot()
    return {tuple(row) for row in torch.cat((carts["table"], carts["motion"])).T.tolist()}


def trained_on(seeds: range) -> set[tuple[float, ...]]:
    """The first carts of the trainings with `seeds`."""
    carts: set[tuple[float, ...]] = set()
    for seed in seeds:
        config = training(seed)
        carts |= begun(simulated_env(config, config.plant, CARTS, config.task.start, config.seed))
    assert len(carts) == CARTS * len(seeds)
    return carts


def test_drawn_carts_are_not_those_of_a_training() -> None:
    seed = 2
    overrides = {"run": "any", "randomization": "wide", "episodes": CARTS, "seed": seed}
    config = load_settings(EvaluateConfig, overrides)
    with closing(evaluated_env(evaluated_settings(training(0), config), config, print)) as env:
        drawn = begun(env)
    assert len(drawn) == CARTS
    assert not drawn & trained_on(range(seed - 2, seed + 3))


@pytest.mark.parametrize("other", [0, 1])
def test_a_trainings_own_evaluations_start_at_other_states(other: int) -> None:
    """Whichever seed another training has; both begin with the starts of their first reset."""
    env, begun_at = nominal_env(training(0, randomization="none", **{"task.time_limit": 1})), []

    def still(present: TensorDictBase) -> TensorDictBase:
        begun_at.append({tuple(row) for row in env.plant.snapshot()["motion"].T.tolist()})
        return present.set("action", torch.zeros(CARTS, dtype=torch.int64))

    judge(env, still, seed=0)
    (starts,) = begun_at
    assert len(starts) == CARTS
    config = training(other, randomization="none")
    learned_from = simulated_env(config, config.plant, CARTS, config.task.start, config.seed)
    assert not starts & {row[-4:] for row in begun(learned_from)}


def test_the_seed_of_an_evaluation_is_no_trainings_and_no_other_evaluations() -> None:
    seeds = (0, 1, 10_000, NUM_SEEDS - 1)
    assert all(NUM_SEEDS <= evaluation_seed(seed) < 2**32 for seed in seeds)
    assert len({evaluation_seed(seed) for seed in seeds}) == len(seeds)


@pytest.mark.parametrize(("episodes", "pole", "carts"), [(1, "both", 2), (5, "both", 6), (100, "range", 100)])
def test_an_evaluation_has_no_fewer_episodes_than_are_asked_for(episodes: int, pole: str, carts: int) -> None:
    settings = {"learning.evaluation_episodes": episodes, "pole": pole, "guard": "none"}
    assert nominal_env(training(0, randomization="none", **settings)).batch_size == (carts,)
