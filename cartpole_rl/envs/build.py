"""Builds environments: over a plant, or from settings over simulated carts."""

from collections.abc import Mapping
from functools import lru_cache
from statistics import fmean
from typing import Any, TypeVar

import torch

from cartpole_rl.checking import validated
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.guard import fitted_guard
from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.envs.settings import (
    LONGEST_POLE,
    CartPoleSettings,
    GuardedPole,
    ObservationSettings,
    TrackGuard,
)
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.learned import model_and_carts
from cartpole_rl.plants.settings import LearnedSettings, PlantSettings, SimulationSettings
from cartpole_rl.plants.specs import Plant
from cartpole_rl.randomization.identified import identified_carts
from cartpole_rl.randomization.poles import possible_poles
from cartpole_rl.randomization.randomizer import Draws, Randomizer
from cartpole_rl.randomization.ranges import IdentifiedSettings
from cartpole_rl.tasks.rewards import speed_periods
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, StartSettings, TaskSettings


def shipped_settings(overrides: Mapping[str, Any] | None = None) -> CartPoleSettings:
    """Return the environment of conf/train.yaml, with `overrides` as in `composition.compose`."""
    from cartpole_rl.composition import compose  # imports Hydra

    composed = compose("train", overrides or {})
    return validated(CartPoleSettings, {name: composed[name] for name in CartPoleSettings.model_fields})


Config = TypeVar("Config", bound=CartPoleSettings)


def with_fitted_guard(config: Config, plant: PlantSettings | None = None) -> Config:
    """Return `config` with the numbers of its track guard, fitted to its carts if they are not given.

    On a learned `plant` they are fitted to the carts of the model. Raises CheckpointError, ConfigError.
    """
    guard = config.guard
    if not guard.enabled or guard.numbers:
        return config
    shared = CartPoleSettings(**{name: getattr(config, name) for name in CartPoleSettings.model_fields})
    if isinstance(plant, LearnedSettings) or isinstance(config.randomization, IdentifiedSettings):
        return with_guard_numbers(config, guard_numbers(shared, plant))
    return with_guard_numbers(config, known_guard_numbers(shared.model_dump_json()))


def with_guard_numbers(config: Config, numbers: TrackGuard | None) -> Config:
    """Return `config` with these numbers of its track guard; with None, it is not fitted yet."""
    return config.model_copy(update={"guard": config.guard.model_copy(update={"numbers": numbers})})


@lru_cache(maxsize=64)
def known_guard_numbers(settings: str) -> TrackGuard:
    """Return `guard_numbers` of settings as JSON: the fit takes a second, and many carts share one."""
    return guard_numbers(CartPoleSettings.model_validate_json(settings))


def guard_numbers(config: CartPoleSettings, plant: PlantSettings | None = None) -> TrackGuard:
    """Return the numbers of the track guard, fitted to the carts of `config` or of a learned `plant`."""
    if isinstance(plant, LearnedSettings):
        draws, models = driven_carts(config, plant)
    else:
        draws = randomizer(config)
        models = Models(config.cart_friction.model, config.pole_friction.model, config.actions.actuator)
    motors, period = config.actions.motors, config.control_period
    track_end = config.nominal_cart["track_half_length"]
    return fitted_guard(config.guard.quantile, draws, motors, models, period, track_end, guarded_pole(config))


def guarded_pole(config: CartPoleSettings) -> GuardedPole:
    """Return the poles of `config` as a track guard knows them, without a swing.

    Raises ConfigError for poles that are too long for one.
    """
    cart, poles = config.nominal_cart, possible_poles(config.pole)
    density = (
        cart["backdrivability"] / cart["cart_mass"] * fmean(each.pole_mass / each.length for each in poles)
    )
    length = None if config.observation.pole_length else fmean(each.length for each in poles)
    if length is not None and length > LONGEST_POLE:
        mean = "" if config.pole.is_single else "mean "
        raise ConfigError(
            f"pole={config.pole.name}: its {mean}length is {length:.3g} m (twice pole_com), and a track "
            f"guard takes at most {LONGEST_POLE:g} m; check pole_com (m), or give guard=none"
        )
    return GuardedPole(swing=0, density=density, length=length)


def make_env(
    plant: Plant,
    actions: ActionSettings,
    task: TaskSettings,
    observation: ObservationSettings,
    reward: RewardSettings,
    guard: TrackGuard | None = None,
    speed_periods: int = 1,
) -> CartPoleEnv:
    """Return the environment over `plant`; its specs do not depend on the plant."""
    encoders, compiled = plant.hardware.encoders, plant.compiled
    hardware = HardwareTransform(
        actions.motors, task, observation, reward, guard, compiled, encoders, speed_periods
    )
    return CartPoleEnv(plant, hardware)


def environment(config: CartPoleSettings, plant: Plant) -> CartPoleEnv:
    """Return the environment of `config` over `plant`, with the track guard of `with_fitted_guard`."""
    config = with_fitted_guard(config)
    task, reward = config.task.at(config.control_period), config.reward.at(config.control_period)
    periods = speed_periods(config.control_period, plant.hardware.encoders)
    return make_env(plant, config.actions, task, config.observation, reward, config.guard.active, periods)


def simulated_env(
    config: CartPoleSettings,
    plant: PlantSettings,
    carts: int,
    start: StartSettings,
    seed: int,
    compiled: bool = False,
    device: torch.device | str = "cpu",
) -> CartPoleEnv:
    """Return an environment over `carts` simulated carts. Raises CheckpointError, ConfigError."""
    config, draws = with_fitted_guard(config, plant), randomizer(config, device)
    return environment(config, plant.build(config, draws, carts, start, seed, compiled, device))


def driven_carts(config: CartPoleSettings, plant: SimulationSettings) -> tuple[Draws, Models]:
    """Return the source of the carts on `plant`, and what moves them. Raises CheckpointError, ConfigError."""
    draws = randomizer(config)
    if not isinstance(plant, LearnedSettings):
        return draws, config.models(plant)
    model, draws = model_and_carts(plant, config, draws)
    return draws, model.models


def randomizer(config: CartPoleSettings, device: torch.device | str = "cpu") -> Draws:
    """Return the source of the carts that `config` describes. Raises ConfigError for impossible carts."""
    if isinstance(config.randomization, IdentifiedSettings):
        return identified_carts(config.randomization, config.nominal_cart, config.pole, device)
    return Randomizer(config.nominal_cart, config.pole, config.randomization, device)
