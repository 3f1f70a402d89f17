"""Builds agents and environments: those of trainings and checkpoints, run=lqr, and a cart to evaluate on."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cartpole_rl.agents.baseline import EnergyAndRegulator
from cartpole_rl.agents.own import OwnPolicy
from cartpole_rl.checking import validated
from cartpole_rl.choices import group_choices
from cartpole_rl.emulator.guards import lever_um
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import environment, simulated_env, with_fitted_guard, with_guard_numbers
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import CartPoleSettings, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import Policy
from cartpole_rl.exporting.agent import ExportedAgent, Layer, canonical_json, description
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import AgentCheckpoint, load_agent, restore_weights
from cartpole_rl.plants.serial.preparation import Confirm, StartPosition, nobody
from cartpole_rl.plants.settings import PlantSettings
from cartpole_rl.plants.specs import tensordict_of
from cartpole_rl.randomization.poles import Pole, PoleSettings, check_one_pole
from cartpole_rl.randomization.ranges import IdentifiedSettings
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_hardware
from cartpole_rl.rig.parameters import check_names, completed
from cartpole_rl.run_folder import (
    BASELINE,
    CHECKPOINTS,
    START,
    find_agent,
    is_own_policy,
    program_of,
    recorded_config,
    recorded_provenance,
)
from cartpole_rl.scheduling import taking_precedence
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.settings import ActionSettings, Start
from cartpole_rl.workflows.checks import check_has_agent, simulated_carts
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig, load_settings, recorded_settings
from cartpole_rl.workflows.poles import guard_holds, other_pole, pole_text, words_of_run

OF_BASELINE = {"observation": "raw", "observation.past_motors": 1}
# settings that an evaluation may replace, beside the task
REPLACEABLE = ("cart", "cart_friction", "pole_friction", "pole", "reward", "guard", "actions")
SAME_RIG = ("pole_counts_per_turn", "cart_nanometres_per_count", "track_span")  # an exported agent's
RECORDED = "recorded"  # in config.yaml: the settings of an agent that was recorded
OUTDATING = {"actions": "other full motor values", "pole": "another pole"}  # a guard's numbers, in words


def new_agent(config: TrainConfig, device: str = "cpu") -> QAgent:
    """Return an untrained agent on `device`."""
    observation, actions = config.observation, len(config.actions.motors)
    settings = config.agent.at(config.control_period)
    return config.agent.kind(settings, observation.mirror_signs, actions, observation.frames, device)


@dataclass(frozen=True)
class TrainedAgent:
    """A policy, the settings that it was trained with, and its `known_poles`, the newest last.

    `transitions` and `score` are those of its checkpoint.
    """

    training: TrainConfig
    policy: Policy
    known_poles: Sequence[PoleSettings] = ()
    transitions: int = 0
    score: float | None = None


def trained_agent(run: Path) -> TrainedAgent:
    """Return the agent of a run folder or a checkpoint file. Raises CheckpointError, ConfigError."""
    check_has_agent(run)
    checkpoint = load_agent(run)
    training = recorded_settings(TrainConfig, checkpoint.config, f"run={run}")
    agent = new_agent(training)
    restore_weights(agent, checkpoint.weights, f"run={run}")
    agent.eval()
    poles = known_poles(training, checkpoint)
    return TrainedAgent(training, agent.greedy_policy(), poles, checkpoint.transitions, checkpoint.score)


def known_poles(training: TrainConfig, checkpoint: AgentCheckpoint) -> list[PoleSettings]:
    """Return the poles that an agent was trained with, and those that it was fine-tuned on.

    Raises ConfigError for a damaged pole.
    """
    return [training.pole, *(validated(PoleSettings, poles) for poles in checkpoint.tuned_poles)]


def evaluated_agent(config: EvaluateConfig) -> TrainedAgent:
    """Return the agent of config.run, the baseline controller or a policy of one's own.

    Raises CheckpointError, ConfigError.
    """
    if is_own_policy(config.run):
        training = own_training(config, ("observation", "actions", "control_period"), {})
        driven = {
            "control_period": training.control_period,
            "observation": training.observation.model_dump(mode="json"),
            "hardware": hardware_of(config.cart or training.cart).model_dump(include={*SAME_RIG}),
        }
        return TrainedAgent(training, OwnPolicy(config.run, training.actions.motors, driven))
    if config.run != BASELINE:
        return trained_agent(config.run)
    return baseline_agent(config, own_training(config, ("actions", "cart", "control_period"), OF_BASELINE))


def own_training(config: EvaluateConfig, names: Sequence[str], choices: Mapping[str, Any]) -> TrainConfig:
    """Return the settings of conf/train.yaml with `choices`, and with what `config` gives under `names`."""
    given = {name: value for name in names if (value := getattr(config, name)) is not None}
    training = load_settings(TrainConfig, choices)
    if track := given.get("cart", {}).get("track_half_length"):
        given["task"] = training.task.model_copy(update={"x_max": track})
    return training.model_copy(update=given)


def baseline_agent(config: EvaluateConfig, training: TrainConfig) -> TrainedAgent:
    """Return energy and LQR for the cart of `training` with the pole of `config`.

    Raises ConfigError for several poles.
    """
    poles = replaced_settings(training, config.model_copy(update={"parameters": None})).pole
    pole = check_one_pole(f"run={BASELINE}", poles)
    policy = EnergyAndRegulator(
        training.nominal_with(pole),
        training.models(training.plant),
        training.actions.motors,
        training.observation.kind,
        training.observation.past_motors,
        training.control_period,
    )
    return TrainedAgent(training, policy)


def compiled_training(trained: TrainedAgent) -> TrainConfig:
    """Return the settings that an agent is exported with: its training's, with a guard for all `known_poles`.

    An agent may have been fine-tuned on a pole that was not in its training, and nobody can tell the board
    which one it drives.
    """
    training = with_fitted_guard(trained.training)
    if training.guard.active is None:
        return training
    others = [pole for pole in trained.known_poles if not guard_holds(training.pole, pole)]
    driven = [with_guard_numbers(training, None).model_copy(update={"pole": pole}) for pole in others]
    guards = [each.guard.active for each in (training, *map(with_fitted_guard, driven)) if each.guard.active]
    return with_guard_numbers(training, reduce(together, guards))


def together(first: TrackGuard, second: TrackGuard) -> TrackGuard:
    """Return a guard that brakes where one of two does; the second one is a single guard."""
    return second.model_copy(update={"also": first})


def exported_agent(trained: TrainedAgent, origin: Mapping[str, Any]) -> ExportedAgent:
    """Return an agent as plain numbers; `origin` is its `provenance`.

    Raises ConfigError for an agent that cannot be exported, CheckpointError for one that is not finite.
    """
    about = description(compiled_training(trained), trained.training.agent, origin)
    agent = ExportedAgent(about, tuple(Layer(*each) for each in network_of(trained).plain_layers()))
    agent.check("run")
    check_plain_layers(agent, trained)
    return agent


@torch.no_grad()
def check_plain_layers(agent: ExportedAgent, trained: TrainedAgent) -> None:
    """Raise ConfigError if the plain layers choose otherwise than the policy, as with another activation."""
    observation = torch.randn(256, agent.description.sizes[0], generator=torch.Generator().manual_seed(0))
    chosen = trained.policy(tensordict_of({"observation": observation}))
    if "action_value" not in chosen:
        raise ConfigError("run: its greedy policy gives no `action_value`, so it cannot be exported")
    values, found = chosen["action_value"].double().numpy(), agent.values(observation.double().numpy())
    tolerance = 1e-3 * (1 + np.abs(values).max())
    best = np.take_along_axis(values, chosen["action"].numpy()[:, None], 1)[:, 0]
    if not (np.abs(found - values) <= tolerance).all() or not (values.max(1) - best <= tolerance).all():
        about = trained.training.agent
        raise ConfigError(
            f"run: an agent with agent.kind={about.kind} and agent.network={about.network} cannot be "
            "exported: its `plain_layers` give other action values than its policy"
        )


def network_of(trained: TrainedAgent) -> Any:
    """Return the network of the greedy policy, from observations to action values. Raises ConfigError."""
    agent = trained.training.agent
    try:
        network = trained.policy.module[0].module  # type: ignore[attr-defined]
        assert callable(network.plain_layers)
    except (AttributeError, TypeError, IndexError):
        own = f"agent.kind={agent.kind}, agent.network={agent.network}"
        raise ConfigError(f"run: an agent with {own} cannot be exported: it has no `plain_layers`") from None
    return network


def provenance(run: Path, agent: TrainedAgent | AgentCheckpoint) -> dict[str, Any]:
    """Return the origin of the `agent` of `run`: its command, versions, commit, transitions and score."""
    folder = find_agent(run).parent
    recorded = recorded_provenance(folder.parent if folder.name == CHECKPOINTS else folder)
    try:
        canonical_json(recorded)
    except ValueError:  # an infinite number
        recorded = {}
    match recorded.get("command"):
        case [str(program), *arguments]:
            command = [Path(program).name, *arguments]
        case _:
            command = []
    return {**recorded, "command": command, "transitions": agent.transitions, "score": agent.score}


def recorded_cart(recordings: Sequence[Path]) -> CartPoleSettings | None:
    """Return the settings of the agent that was recorded, from the run folder; None where it is unknown.

    Raises CheckpointError for settings of another version.
    """
    folder = recordings[0].parent.parent
    if program_of(folder) == "finetune":
        start = folder / CHECKPOINTS / START  # while it is not finished
        training = trained_agent(start if start.exists() else folder).training
        return CartPoleSettings(**{name: getattr(training, name) for name in CartPoleSettings.model_fields})
    recorded = recorded_config(folder).get(RECORDED)
    if not recorded or program_of(folder) not in ("record", "import"):
        return None
    return recorded_settings(CartPoleSettings, recorded, f"from={folder}")


def evaluated_settings(training: TrainConfig, config: EvaluateConfig) -> CartPoleSettings:
    """Return the settings to evaluate with: `replaced_settings` with the numbers of the track guard.

    A new guard is fitted to the carts that `config` randomizes, or else to those of the training: an
    evaluation without randomization may drive a real cart. The guard of the training is fitted anew to the
    settings that make it `outdated`. On plant=learned, either is fitted to the carts of the model. Raises
    ConfigError.
    """
    settings = replaced_settings(training, config)
    fitted_to = settings.model_copy(update={"randomization": config.randomization or training.randomization})
    if changes := outdated(training, config):
        fitted_to = with_guard_numbers(training, None).model_copy(update=changes)
    return settings.model_copy(update={"guard": with_fitted_guard(fitted_to, config.plant).guard})


def outdated(training: TrainConfig, config: EvaluateConfig) -> dict[str, Any]:
    """Return the replaced settings for which the numbers of the training's guard do not hold, by name.

    They are what a person knows of a real cart: other full motor values, and a pole that is longer,
    shorter or heavier than those in training.
    Carts that simulation changes in other ways meet the guard that a real one of their kind would meet. The
    guard of a policy on a real board cannot be changed. Raises ConfigError.
    """
    if config.guard is not None or training.guard.active is None or config.plant.has_compiled_agent:
        return {}
    driven = replaced_settings(training, config.model_copy(update={"parameters": None}))
    motors, trained = driven.actions.motors, training.actions
    changes: dict[str, Any] = {}
    if (min(motors), max(motors)) != (min(trained.motors), max(trained.motors)):
        changes["actions"] = trained.model_copy(update={"motors": motors})
    if not guard_holds(training.pole, driven.pole):
        changes["pole"] = driven.pole
    return changes


def driving_notes(
    training: TrainConfig, known: Sequence[PoleSettings], config: EvaluateConfig, settings: CartPoleSettings
) -> Iterator[str]:
    """Yield a line for each way in which the driven cart differs from those of an agent of `known` poles."""
    pole = other_pole(known, settings.pole, config.plant.reads_emulator) if known else None
    notes = pole, guard_note(training, config, settings), identified_note(training, config)
    yield from filter(None, notes)


def guard_note(training: TrainConfig, config: EvaluateConfig, settings: CartPoleSettings) -> str | None:
    """Return a line about the guard of `evaluated_settings` if it was fitted anew, None if not."""
    changes = outdated(training, config)
    if not changes:
        return None
    others = " and ".join(OUTDATING[name] for name in changes)
    pole = f" to {pole_text(settings.pole)}" if "pole" in changes else ""
    return (
        f"note: the track guard of the training is for {others}; fitted anew{pole}: {settings.guard.active}"
    )


def identified_note(training: TrainConfig, config: EvaluateConfig) -> str | None:
    """Return a line about the emulated cart if it is made from the numbers of an identified emulated one."""
    emulated, drawn = config.plant.reads_emulator and config.emulator.cart is None, training.randomization
    if not emulated or training.hardware == nominal_hardware() or not isinstance(drawn, IdentifiedSettings):
        return None
    if not (words_of_run(drawn.posterior.parent) or "").startswith("plant=emulated"):
        return None
    same = [name for name, cart in group_choices("cart").items() if hardware_of(cart) == training.hardware]
    file = same[0] if same else "<the cart= of cartpole-identify>"
    return (
        "note: the emulated cart differs from the identified one as the default cart from ip02; to drive the "
        f"cart that was identified, give emulator.cart={file}"
    )


def replaced_settings(training: TrainConfig, config: EvaluateConfig) -> CartPoleSettings:
    """Return the settings of the agent's training, with those that `config` replaces. Raises ConfigError."""
    own = {name: getattr(training, name) for name in CartPoleSettings.model_fields}
    given = {name: value for name in REPLACEABLE if (value := getattr(config, name)) is not None}
    if config.task is not None or config.cart is not None:
        task, x_max = config.task or training.task, training.task.x_max
        if x_max == training.nominal_cart["track_half_length"]:  # not one that was chosen for the training
            x_max = (config.cart or {}).get("track_half_length", x_max)
        given["task"] = {**task.model_dump(), "x_max": (config.task and config.task.x_max) or x_max}
    if config.pole is None and (own_pole := config.plant.own_pole(config.emulator, training.pole)):
        given["pole"] = own_pole
    if config.actions is not None:
        check_same_meaning(config.actions, training.actions)
    if config.cart is not None and config.run != BASELINE and not is_own_policy(config.run):
        check_same_rig("cart", hardware_of(config.cart), training.hardware)
    settings = validated(CartPoleSettings, {**own, **given, "randomization": config.randomization})
    return with_parameters(settings, config.parameters or {})


def check_same_rig(setting: str, given: Hardware, trained: Hardware) -> None:
    """Raise ConfigError, which names the setting, unless a rig has the encoders and track of the training."""
    if given.scales_text != trained.scales_text:
        raise ConfigError(
            f"{setting}: it has {given.scales_text}, but the agent was trained for {trained.scales_text}; "
            "train one for this cart"
        )


def check_same_meaning(actions: ActionSettings, trained: ActionSettings) -> None:
    """Raise ConfigError unless the motor values have the number, signs and order of those in training."""
    given, known = actions.motors, trained.motors
    if len(given) != len(known):
        raise ConfigError(
            f"actions: {len(given)} motor values, but the agent chooses from {len(known)}; give {len(known)}"
        )
    if order_and_signs(given) != order_and_signs(known):
        raise ConfigError(
            f"actions.motors={[*given]}: the agent would push in other directions than in its training; give "
            f"values with the signs and in the order of {[*known]}"
        )


def order_and_signs(motors: Sequence[int]) -> list[tuple[int, int]]:
    """Return the rank and the sign of each motor value."""
    return [(sorted(motors).index(motor), (motor > 0) - (motor < 0)) for motor in motors]


def predicting_env(settings: CartPoleSettings, plant: PlantSettings, seed: int) -> CartPoleEnv:
    """Return a simulated cart that predicts an episode on a real one. Raises ConfigError."""
    nominal = settings.model_copy(update={"randomization": {}})
    return simulated_env(nominal, plant, 1, settings.task.evaluation_start, evaluation_seed(seed))


def with_parameters(settings: CartPoleSettings, parameters: Mapping[str, float]) -> CartPoleSettings:
    """Return `settings` with `parameters` of the cart and the pole replaced. Raises ConfigError."""
    check_names(parameters, "parameters")
    of_pole = {name: value for name, value in parameters.items() if name in Pole.model_fields}
    of_cart = {name: value for name, value in parameters.items() if name not in Pole.model_fields}
    if of_pole and settings.pole.choices is None:
        raise ConfigError(
            f"parameters: the rod's length gives its {', '.join(of_pole)}; choose one pole, as pole=medium"
        )
    poles = {name: pole.model_copy(update=of_pole) for name, pole in (settings.pole.choices or {}).items()}
    return settings.model_copy(
        update={
            "cart": {**settings.cart, **settings.nominal_cart, **of_cart},
            "cart_friction": settings.cart_friction.model_copy(update={"parameters": {}}),
            "pole_friction": settings.pole_friction.model_copy(update={"parameters": {}}),
            "pole": PoleSettings(choices=poles) if poles else settings.pole,
        }
    )


def evaluated_env(
    settings: CartPoleSettings,
    config: EvaluateConfig,
    prompt: Callable[[str], None],
    confirm: Confirm = nobody,
) -> CartPoleEnv:
    """Return the environment to evaluate in: simulated carts, one for each episode, or one cart on a port.

    `prompt` shows a person what to do; `confirm` asks whether a latched fault may be cleared.
    """
    start = settings.task.evaluation_start
    carts, seed = simulated_carts(config), evaluation_seed(config.seed)
    if not config.plant.is_on_port:
        return simulated_env(settings, config.plant.as_evaluated, carts, start, seed)
    if start.angle is Start.ANY:
        raise ConfigError("task.evaluation_start.angle=any: a cart can start only upright or hanging")
    angle: StartPosition = "upright" if start.angle is Start.UPRIGHT else "hanging"
    emulator = config.emulator.model_copy(update={"seed": config.emulator.seed + config.seed})
    numbers = with_shaking_pole(settings.cart, settings.pole)
    plant = config.plant.build(emulator, settings.control_period, angle, prompt, confirm, numbers)
    try:
        return environment(settings, plant)
    except BaseException:
        plant.close()
        raise


def with_shaking_pole(cart: Mapping[str, float], poles: PoleSettings) -> dict[str, float]:
    """Return the numbers of a cart with the pole that shakes it most: the one with the longest lever."""
    rigs = [{**cart, **pole.model_dump()} for pole in (poles.each.choices or {}).values()]
    return max(rigs, key=lambda numbers: lever_um(completed(numbers)))


def precedence(plant: PlantSettings, emulator: EmulatorSettings) -> AbstractContextManager[None]:
    """Return a context with real-time priority for a cart with its own clock."""
    return taking_precedence() if plant.is_real_time(emulator) else nullcontext()


THREADS = {"own": 0, "used": 0}  # torch's threads without `use_threads`, and those that it set last


def use_threads(threads: int | None) -> None:
    """Set the number of torch's threads; None gives back the number before an earlier job in this process."""
    if (present := torch.get_num_threads()) != THREADS["used"]:  # torch's own choice, or its user's
        THREADS["own"] = present
    THREADS["used"] = THREADS["own"] if threads is None else threads
    torch.set_num_threads(THREADS["used"])
