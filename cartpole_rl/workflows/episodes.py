"""Whole episodes of an agent on any cart, as evaluations and recordings drive them.

`repeat=` drives one episode of an earlier evaluation again: the same simulated cart from the same start.
"""

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cartpole_rl.checking import validated
from cartpole_rl.emulator.settings import ONBOARD
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import Knocks, Policy, run_batch, run_episodes, run_onboard_episodes
from cartpole_rl.evaluation.recordings import read_origin
from cartpole_rl.evaluation.snapshots import followed
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.exporting.c_code import c_files
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.reporting.texts import guard_text
from cartpole_rl.reporting.web_view import chosen_view
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.run_folder import (
    AGENT_HASH,
    BASELINE,
    METRICS,
    check_program,
    file_hash,
    is_own_policy,
    recorded_config,
    recorded_provenance,
)
from cartpole_rl.tasks.episode import Episode, Origin
from cartpole_rl.terminal import confirm, print_message, progress_bar, waiting
from cartpole_rl.workflows.build import (
    TrainedAgent,
    check_same_rig,
    compiled_training,
    driving_notes,
    evaluated_agent,
    evaluated_env,
    evaluated_settings,
    exported_agent,
    precedence,
    predicting_env,
    provenance,
    trained_agent,
    use_threads,
)
from cartpole_rl.workflows.checks import agent_file, note_other_numbers, simulated_carts
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig


@dataclass(frozen=True)
class Repetition:
    """An episode to repeat."""

    config: EvaluateConfig  # of that evaluation, with this cart only
    origin: Origin
    row: int  # in the batch; another batch or row would be rounded differently
    score: float  # in that evaluation


@dataclass(frozen=True)
class Evaluation:
    """A policy in its environment, ready to be driven. The environment has to be closed."""

    config: EvaluateConfig
    settings: CartPoleSettings
    env: CartPoleEnv
    policy: Policy
    repetition: Repetition | None
    training: TrainConfig
    known_poles: Sequence[PoleSettings]  # of the agent
    simulation: CartPoleEnv | None  # that predicts the first episode
    on_board: ExportedAgent | None  # that the cart's board should have; None if it does not drive
    agent_content: bytes | None  # of its file, which another training may overwrite; None without one

    def episodes(self) -> Iterator[Episode]:
        """Drive the repeated episode, or new ones, and yield each as it ends."""
        knocks = Knocks(self.env.plant, self.config.knock) if self.config.knock else None
        if self.repetition:
            again = repeated(self.env, self.policy, self.repetition, knocks)
            yield from self._shown(again, "episodes", self.repetition.row)
        else:
            driven = run_episodes(self.env, self.policy, self.config.episodes, knocks)
            yield from self._shown(driven, "episodes")

    def print_notes(self, command: str) -> None:
        """Print what differs from the training, and the numbers of a simulated cart that are not nominal."""
        for note in driving_notes(self.training, self.known_poles, self.config, self.settings):
            print_message(command, note)
        if not self.config.plant.is_on_port:
            poles = (self.settings.pole.choices or {}).values()
            note_other_numbers(command, self.settings.nominal_cart, poles)

    def check_board(self) -> None:
        """Raise PlantError if the cart's board shall drive and has no agent, or another one."""
        if self.on_board is not None:
            length = self.env.plant.pole_length.item() if self.settings.observation.pole_length else 0.0
            self.env.plant.check_policy(self.on_board.identity_with(length))

    def onboard_episodes(self) -> Iterator[Episode]:
        """Let the policy on the cart's board drive, and yield each episode as it ends."""
        driven = run_onboard_episodes(self.env, self.policy, self.config.episodes)
        yield from self._shown(driven, "episodes on the board")

    def _shown(self, episodes: Iterator[Episode], name: str, row: int = 0) -> Iterator[Episode]:
        """Drive episodes behind a progress bar with the score of each, and a view of the cart in `row`."""
        config, measure = self.config, self.settings.task.measure
        with chosen_view(config.plant.title, config.view, self.settings.pole.nominal.length) as view:
            followed(self.env, view.memory, row)
            text = "" if config.view == "live" else name  # that view draws on the terminal itself
            thread = not config.plant.is_real_time(config.emulator)
            priority = precedence(config.plant, config.emulator)
            with waiting(text, thread=thread), priority, progress_bar(config.episodes, name) as progress:
                for episode in episodes:
                    score = f"{measure} {episode.total(measure):z.0f}{guard_text(episode)}"
                    progress.set_postfix_str(score, refresh=False)
                    progress.update()
                    yield episode


@waiting("preparing the cart and its track guard")
def prepared(config: EvaluateConfig) -> Evaluation:
    """Load the agent of `config` and build its environment. Raises CartPoleError."""
    again = repetition(config)
    if again:
        config = again.config
    use_threads(config.threads)
    seed_everything(config.seed)
    agent, content = loaded_agent(config)
    training = compiled_training(agent) if config.plant.has_compiled_agent else agent.training
    settings = evaluated_settings(training, config)
    simulation = (
        predicting_env(settings, agent.training.plant, config.seed) if config.animation.simulation else None
    )
    drives = config.drives_on_board
    on_board = exported_agent(agent_on_board(config, agent, settings), {}) if drives else None
    with on_the_board(config, agent, settings) as equipped:
        env = evaluated_env(settings, equipped, partial(tqdm.write, file=sys.stderr), confirm)
    return Evaluation(
        config,
        settings,
        env,
        agent.policy,
        again,
        agent.training,
        agent.known_poles,
        simulation,
        on_board,
        content,
    )


def loaded_agent(config: EvaluateConfig) -> tuple[TrainedAgent, bytes | None]:
    """Return the agent, and the content of its file, if it has one. Raises CheckpointError, ConfigError.

    Both are of one version of the file, which a training that goes on replaces now and then.
    """
    file = agent_file(config.run)
    while True:
        version = file.stat().st_mtime_ns if file else 0
        agent = evaluated_agent(config)
        content = file.read_bytes() if file else None
        if not file or file.stat().st_mtime_ns == version:
            return agent, content


def repeated(env: CartPoleEnv, policy: Policy, again: Repetition, knocks: Knocks | None) -> Iterator[Episode]:
    """Drive the same simulated cart from the same start."""
    env.plant.start_from(again.origin.state)
    yield run_batch(env, policy, knocks)[again.row]


@contextmanager
def on_the_board(
    config: EvaluateConfig, trained: TrainedAgent, settings: CartPoleSettings
) -> Iterator[EvaluateConfig]:
    """Yield `config`; with emulator.policy=onboard its emulated cart has the agent on its board.

    The agent has the actions, guard and task of `settings`, as on this computer. Its files are needed
    until the cart has started. Raises ConfigError for an agent that cannot be exported, and if `settings`
    are not those of the agent on the board of a real cart.
    """
    if config.plant.has_compiled_agent:
        check_compiled_settings(trained, settings)
    if config.emulator.policy != ONBOARD:
        yield config
        return
    evaluated = agent_on_board(config, trained, settings)
    files = c_files(exported_agent(evaluated, provenance(config.run, trained)), evaluated.training)
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        emulator = config.emulator.model_copy(update={"policy": Path(folder)})
        yield config.model_copy(update={"emulator": emulator})


def agent_on_board(config: EvaluateConfig, trained: TrainedAgent, settings: CartPoleSettings) -> TrainedAgent:
    """Return the agent that the board should have: on an emulated cart, one with `settings`."""
    if config.plant.has_compiled_agent:
        return trained
    return TrainedAgent(trained.training.model_copy(update=dict(settings)), trained.policy)


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


def repetition(config: EvaluateConfig) -> Repetition | None:
    """Return the episode that `config` repeats; None if it repeats none. Raises ConfigError."""
    run, number = config.repeat.run, config.repeat.episode
    if run is None and number is None:
        return None
    if run is None:
        raise ConfigError("repeat.run is missing; give repeat.run=..., the run folder of an evaluation")
    recorded, metrics = read_evaluation(run)
    count = len(metrics["episodes"])
    if number is None:
        raise ConfigError(f"repeat.episode is missing; give repeat.episode=0 to {count - 1}")
    if number >= count:
        raise ConfigError(f"repeat.episode={number}: repeat.run={run} has episodes 0 to {count - 1}")
    try:
        origin = read_origin(metrics, number)
    except LookupError:
        raise ConfigError(
            f"repeat.run={run}: its {METRICS} has no cart for each episode; evaluate again"
        ) from None
    if config.run != BASELINE and not is_own_policy(config.run):
        check_same_cart(config, recorded["evaluated"])
    batch_number = (recorded.get("repeat") or {}).get("episode")
    evaluation = same_evaluation(config, recorded, origin)
    row = (number if batch_number is None else batch_number) % simulated_carts(evaluation)
    return Repetition(evaluation, origin, row, metrics["episodes"][number]["score"])


def check_same_cart(config: EvaluateConfig, evaluated: Mapping[str, Any]) -> None:
    """Raise ConfigError unless the agent has the encoders, track and period of what was `evaluated`."""
    training = trained_agent(config.run).training
    check_same_rig(f"repeat.run={config.repeat.run}", hardware_of(evaluated["cart"]), training.hardware)
    if (period := evaluated["control_period"]) != training.control_period:
        raise ConfigError(
            f"repeat.run={config.repeat.run}: it was driven every {1e3 * period:g} ms, and the agent drives "
            f"every {1e3 * training.control_period:g} ms; give an agent of that period"
        )


def read_evaluation(run: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the config, with the hash of the agent, and the metrics of an evaluation in simulation.

    Raises ConfigError.
    """
    check_program("repeat.run", run, "evaluate")
    try:
        recorded = {**recorded_config(run), AGENT_HASH: recorded_provenance(run).get(AGENT_HASH)}
        metrics = json.loads((run / METRICS).read_text(encoding="utf-8"))
        plant, _ = metrics["plant"], recorded["evaluated"]
    except (OSError, ValueError, LookupError, TypeError):
        raise ConfigError(
            f"repeat.run={run}: it is not a finished run of cartpole-evaluate; give the run folder of one"
        ) from None
    if plant != "simulated":
        raise ConfigError(
            f"repeat.run={run}: it drove plant={plant}, whose episodes cannot be repeated; give a run "
            "with plant=simulated"
        )
    return recorded, metrics


def same_evaluation(config: EvaluateConfig, recorded: Mapping[str, Any], origin: Origin) -> EvaluateConfig:
    """Return the recorded evaluation with the agent of `config`, on that cart only. Raises ConfigError.

    The guard is the one of then if it was chosen, or if the agent is the same; else it is the agent's own.
    """
    former = {name: recorded[name] for name in EvaluateConfig.model_fields if name in recorded}
    own = {name: getattr(config, name) for name in ("run", "label", "repeat", "animation", "view")}
    pole = {name: origin.parameters[name] for name in Pole.model_fields}
    of_cart = {name: value for name, value in origin.parameters.items() if name not in pole}
    one_cart: dict[str, Any] = {
        "parameters": of_cart,
        "pole": {"choices": {f"{2 * pole['pole_com']:.2f} m": pole}},
        "randomization": {},
    }
    same_agent = Path(former["run"]).resolve() == config.run.resolve()
    if (used := recorded.get(AGENT_HASH)) and (file := agent_file(config.run)):
        same_agent = file_hash(file) == used
    if same_agent and config.run == BASELINE:  # it is designed for the chosen pole, whatever the cart has
        one_cart |= {"parameters": origin.parameters, "pole": former.get("pole")}
    if former.get("guard") or same_agent:  # its numbers may be of all the poles then
        one_cart["guard"] = recorded["evaluated"]["guard"]
    return validated(EvaluateConfig, {**former, **own, **one_cart})
