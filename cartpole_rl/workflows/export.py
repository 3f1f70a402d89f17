"""Write a trained agent for other programs."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import Any

from cartpole_rl.emulator.settings import ONBOARD
from cartpole_rl.envs.build import with_fitted_guard
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.agent import ExportedAgent, Layer, canonical_json, description
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.exporting.onnx_model import onnx_model
from cartpole_rl.exporting.web_page import web_page
from cartpole_rl.files import write_bytes
from cartpole_rl.learning.checkpoints import load_agent
from cartpole_rl.plants.settings import SimulatedSettings
from cartpole_rl.run_folder import CHECKPOINTS, find_agent, recorded_provenance, write_config
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import without_guard_numbers
from cartpole_rl.workflows.config import EvaluateConfig, ExportConfig, TrainConfig
from cartpole_rl.workflows.trained_poles import guard_holds


def export(config: ExportConfig, folder: Path) -> None:
    """Write the agent of `config.run` as `config.format`.

    Writes into `folder` config.yaml, provenance.json and agent.npz, agent.onnx, policy.h and policy.c, or
    cart.html. Raises CheckpointError for a missing or damaged agent, ConfigError for one that cannot be
    exported, or for a folder that already holds a run.
    """
    trained = trained_agent(config.run)
    agent = exported_agent(trained, provenance(config.run))
    contents = files_of(config.format, agent, trained)
    write_config(folder, "export", {**config.model_dump(mode="json"), "seed": None})
    for name, content in contents.items():
        write_bytes(folder / name, content)
    files = " and ".join(f"{folder}/{name}" for name in contents)
    print(f"{files} {'are' if len(contents) > 1 else 'is'} written; SHA-256 of the agent: {agent.checksum}")


@contextmanager
def on_the_board(
    config: EvaluateConfig, trained: TrainedAgent, settings: CartPoleSettings
) -> Iterator[EvaluateConfig]:
    """Yield `config`; with emulator.policy=onboard its emulated cart has the agent on its board.

    The agent has the actions, guard and task of `settings`, as on this computer. Its files are needed
    until the cart has started. Raises ConfigError for an agent that cannot be exported, and if `settings`
    are not those of the agent on the board of a real cart.
    """
    if config.has_compiled_agent:
        check_compiled_settings(trained, settings)
    if config.emulator.policy != ONBOARD:
        yield config
        return
    evaluated = agent_on_board(config, trained, settings)
    contents = files_of("c", exported_agent(evaluated, provenance(config.run)), evaluated)
    with tempfile.TemporaryDirectory() as folder:
        for name, content in contents.items():
            Path(folder, name).write_bytes(content)
        emulator = config.emulator.model_copy(update={"policy": Path(folder)})
        yield config.model_copy(update={"emulator": emulator})


def agent_on_board(config: EvaluateConfig, trained: TrainedAgent, settings: CartPoleSettings) -> TrainedAgent:
    """Return the agent that the board should have: on an emulated cart, one with `settings`."""
    if config.has_compiled_agent:
        return trained
    shared = {name: getattr(settings, name) for name in CartPoleSettings.model_fields}
    return TrainedAgent(trained.training.model_copy(update=shared), trained.policy)


def compiled_training(trained: TrainedAgent) -> TrainConfig:
    """Return the settings that an agent is exported with: its training's, with a guard for all `known_poles`.

    An agent may have been fine-tuned on a pole that was not in its training, and nobody can tell the board
    which one it drives.
    """
    training = with_fitted_guard(trained.training)
    if training.guard.active is None:
        return training
    others = [pole for pole in trained.known_poles if not guard_holds(training.pole, pole)]
    driven = [without_guard_numbers(training).model_copy(update={"pole": pole}) for pole in others]
    guards = [each.guard.active for each in (training, *map(with_fitted_guard, driven)) if each.guard.active]
    numbers = reduce(TrackGuard.at_least, guards)
    return training.model_copy(update={"guard": training.guard.model_copy(update={"numbers": numbers})})


def check_compiled_settings(trained: TrainedAgent, settings: CartPoleSettings) -> None:
    """Raise ConfigError if `settings` differ from those that the agent is exported with."""
    compiled = compiled_training(trained)
    differs = {
        "actions": settings.actions.motors != compiled.actions.motors,
        "guard": settings.guard.active != compiled.guard.active,
        "task": settings.task.angle_limit != compiled.task.angle_limit,
    }
    if any(differs.values()):
        names = ", ".join(name for name in differs if differs[name])
        raise ConfigError(
            f"{names}: with plant.policy=onboard the board has those that the agent was exported with; "
            f"leave out {names}"
        )


def exported_agent(trained: TrainedAgent, origin: Mapping[str, Any]) -> ExportedAgent:
    """Return an agent as plain numbers; `origin` is its `provenance`.

    Raises ConfigError for an agent that cannot be exported, CheckpointError for one that is not finite.
    """
    about = description(compiled_training(trained), trained.training.agent, origin)
    agent = ExportedAgent(about, tuple(Layer(*each) for each in network_of(trained).plain_layers()))
    agent.check("run")
    return agent


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


def provenance(run: Path) -> dict[str, Any]:
    """Return the origin of the agent of `run`: its command, versions, commit, transitions and score."""
    checkpoint, recorded = load_agent(run), provenance_beside(find_agent(run))
    match recorded.get("command"):
        case [str(program), *arguments]:
            command = [Path(program).name, *arguments]
        case _:
            command = []
    return {
        **recorded,
        "command": command,
        "transitions": checkpoint.transitions,
        "score": checkpoint.score,
    }


def provenance_beside(agent: Path) -> dict[str, Any]:
    """Return the provenance.json of the run that wrote `agent`; empty if it is missing or damaged."""
    folder = agent.parent.parent if agent.parent.name == CHECKPOINTS else agent.parent
    recorded = recorded_provenance(folder)
    try:
        canonical_json(recorded)
    except ValueError:  # an infinite number
        return {}
    return recorded


def files_of(form: str, agent: ExportedAgent, trained: TrainedAgent) -> dict[str, bytes]:
    """Return the contents of the files of a format, by name. Raises ConfigError."""
    match form:
        case "weights":
            return {"agent.npz": agent.weights_file()}
        case "onnx":
            return {"agent.onnx": onnx_model(agent, network_of(trained))}
        case "c":
            return {name: text.encode() for name, text in c_files(agent, trained.training).items()}
        case _:
            return {"cart.html": page(agent, trained).encode()}


def page(agent: ExportedAgent, trained: TrainedAgent) -> str:
    """Return cart.html. Raises ConfigError for an agent that was not trained in simulation."""
    plant = trained.training.plant
    if not isinstance(plant, SimulatedSettings):
        raise ConfigError(f"format=web: the agent was trained with plant={plant.kind}, not plant=simulated")
    return web_page(agent, trained.training, plant)
