"""Train an agent in randomized simulation, from settings to a run folder."""

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cartpole_rl.envs.build import driven_carts, simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy, as_weights
from cartpole_rl.evaluation.episodes import Policy, run_batch
from cartpole_rl.evaluation.metrics import episode_metrics
from cartpole_rl.files import claimed, write_text
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import (
    AgentCheckpoint,
    TrainingCheckpoint,
    forget_training,
    load_training,
    restore_weights,
    save_agent,
    save_training,
    whole_state,
)
from cartpole_rl.learning.dqn import Monitor, Scalars, Training
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.effects import without_effect
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.randomization.ranges import IdentifiedSettings
from cartpole_rl.reporting.animation import gif
from cartpole_rl.reporting.episodes import behaviour, columns, report_episodes
from cartpole_rl.reporting.loggers import Loggers
from cartpole_rl.reporting.randomization import drawn_carts
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.web_view import WebView
from cartpole_rl.run_folder import (
    BEST,
    CHECKPOINTS,
    CONFIG,
    FIGURES,
    HISTORY,
    LAST,
    METRICS,
    file_hash,
    write_config,
)
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import (
    as_word,
    print_message,
    print_results,
    progress_bar,
    shown,
    waiting,
    words_given,
)
from cartpole_rl.workflows.build import new_agent, use_threads
from cartpole_rl.workflows.checks import check_compiler, check_resumable, note_other_numbers
from cartpole_rl.workflows.config import TrainConfig, recorded_settings
from cartpole_rl.workflows.poles import emulated_words, words_of_run

ROUNDING = 1e-6  # share: that of float32
FALLEN = 0.9  # of the best score: a training that ends below it says so
OF_CARTS = ("cart", "cart_friction", "pole_friction")
LEAST = 10.0  # score of an agent that has learned something
GUARDED = "guarded_fraction"  # None without a track guard
COMPARED = ("score", "score_upright", "steps", "time_to_upright_s", "upright_fraction", GUARDED)  # at the end
TAGS = {GUARDED: "track_guard_fraction"}  # of curves, which are sorted by name: the score comes first
AVERAGED = ("score", "score_upright", "steps", "upright_fraction")  # over the episodes of an evaluation
PICTURES = 4  # behaviour figures and animations, over the whole training


@waiting("preparing: fitting the track guard, compiling")
def train(config: TrainConfig, folder: Path) -> float | None:
    """Train an agent on randomized simulated carts, or resume the training in `folder`; return its score.

    The score is the task's: (6.1) for a balance, (6.2) for a swing-up.
    Writes config.yaml, provenance.json, the logger's files, history.jsonl (evaluations), checkpoints/last.pt
    and best.pt, metrics.json and figures/; until the end also checkpoints/resume.pt. Raises ConfigError for
    settings that do not fit together or a folder that already holds a run, CheckpointError for a resumed run
    without a checkpoint, LearningError if learning diverges.
    """
    if config.preview:
        preview(config, folder)
        return None
    checkpoint = None
    if config.resume is not None:
        check_resumable("train", config.resume, folder)
        checkpoint = load_training(Path(config.resume))
        config = recorded_settings(TrainConfig, checkpoint.config, f"resume={folder}")
    config = config.model_copy(update={"device": available_device(config.device)})
    if config.compile:
        check_compiler(config.device)
    use_threads(config.threads)
    seed_everything(config.seed)
    config = with_fitted_guard(config, config.plant)
    carts, start = config.learning.carts, config.task.start
    env = simulated_env(config, config.plant, carts, start, config.seed, config.compile, config.device)
    agent = new_agent(config, config.device)
    if checkpoint:  # before any work
        restore_weights(agent, checkpoint.state.get("agent", {}), f"resume={folder}")
    policy = DrivingPolicy(agent.greedy_policy(), config.compile)
    evaluate = partial(judge_agent, nominal_env(config), agent, policy, config.seed)
    if checkpoint is None:
        config.check_learning()
    with claimed(folder):
        write_config(folder, "train", config.model_dump(mode="json"), resumed=checkpoint is not None)
        print_notes(config, env.plant.randomizer, env.plant.models)
        if checkpoint:
            warn_of_changes(checkpoint.drawn_from)
        step = checkpoint.step if checkpoint else None
        with training_view(config, folder) as view, TrainingMonitor(folder, config, step, view) as monitor:
            settings = config.learning.at(config.control_period), config.buffer, config.optimizer
            run = config.seed, config.compile, config.task.measure
            training = config.agent.kind.learner(*settings, agent, env, evaluate, monitor, *run)
            if checkpoint:
                with whole_state(f"resume={folder}"):
                    training.restore(checkpoint.state)
            else:
                monitor.randomization(env.plant)
            training.run()
            drawn = config.plant.kind, config.pole, config.task, config.nominal_cart["track_half_length"]
            metrics = report_episodes(folder, evaluate(), *drawn, history=monitor.history)
            monitor.finished(metrics)
        forget_training(folder)
    print(f"trained for {training.seconds:.0f} s")
    if fall := fall_note([evaluation[config.task.measure] for evaluation in monitor.history]):
        print(fall)
    identified = config.randomization
    source = shown(identified.posterior.parent) if isinstance(identified, IdentifiedSettings) else None
    cart = (source and words_of_run(source)) or emulated_words([config.pole])
    following = f"cartpole-evaluate {as_word('run', shown(folder))} {cart}"
    print_results(folder, f"{METRICS}, {FIGURES}/ and {CHECKPOINTS}/", following)
    score: float = metrics[config.task.measure]["mean"]
    return score


def training_view(config: TrainConfig, folder: Path) -> AbstractContextManager[WebView | None]:
    """Return the page of `view=web`, or nothing."""
    if config.view == "none":
        return nullcontext()
    return WebView(f"Training in {shown(folder)}", config.pole.nominal.length, (), grows=True)


def preview(config: TrainConfig, folder: Path) -> None:
    """Write a picture of the carts that a training draws. Raises ConfigError if all are alike."""
    path = folder / FIGURES / "randomization.png"
    save(drawn_carts(driven_carts(config, config.plant)[0], config.seed), path)
    print(f"{path} shows the drawn carts")


def fall_note(scores: Sequence[float]) -> str | None:
    """Return a line if the last evaluation's score is more than a tenth below the best, None if not."""
    best = max(scores, default=0.0)
    if best < LEAST or scores[-1] >= FALLEN * best:
        return None
    return (
        f"note: the last evaluation scored {scores[-1]:z.0f}, the best {best:.0f}: the agent became worse; "
        f"{CHECKPOINTS}/{BEST} is the best one, but train again with another seed"
    )


def available_device(device: str) -> str:
    """Return "cpu" or "cuda" for `device`, where "auto" is "cuda" if there is a GPU.

    Raises ConfigError for "cuda" without a GPU.
    """
    found = torch.cuda.is_available()
    if device == "auto":
        return "cuda" if found else "cpu"
    if device == "cuda" and not found:
        raise ConfigError(
            "device=cuda: PyTorch finds no CUDA GPU on this machine; start a training with device=cpu "
            "(a resumed one keeps its device)"
        )
    return device


def print_notes(config: TrainConfig, draws: Draws, models: Models) -> None:
    """Print how the cart differs from the nominal one and from those in training, and its track guard."""
    if "cart" not in config.plant.ignored:
        note_other_numbers("train", config.nominal_cart, (config.pole.choices or {}).values())
        note_blocked_track(config)
        note_other_carts(config, draws)
    elif given := [word for word in words_given(*OF_CARTS) if not word.strip("'").startswith("cart=")]:
        print_message(
            "train",
            f"note: {', '.join(given)}: plant={config.plant.kind} has its own cart and friction; only carts "
            "that are drawn from randomization= have these numbers",
        )
    note_unused_randomization(config, draws, models)
    if config.guard.active:
        print_message("train", f"track guard: {config.guard.active}")


def note_blocked_track(config: TrainConfig) -> None:
    """Print that the cart's firmware blocks a part of the track that the training uses."""
    end, soft = (
        config.nominal_cart["track_half_length"],
        config.hardware.half_span - config.hardware.soft_limit,
    )
    if end > soft * (1 + ROUNDING):
        print_message(
            "train",
            f"note: cart.track_half_length is {end:g} m, and from the soft limit at {soft:g} m on "
            "(half of track_span, less soft_limit) the cart takes no outward motor value",
        )


def warn_of_changes(drawn_from: Mapping[str, str]) -> None:
    """Warn of each file that the carts come from and that no longer has this SHA-256."""
    for name, was in drawn_from.items():
        if Path(name).is_file() and file_hash(Path(name)) != was:
            print_message(
                "train", f"warning: {name} has changed since: the training goes on with other carts"
            )


def note_unused_randomization(config: TrainConfig, draws: Draws, models: Models) -> None:
    """Print the ranges that change nothing with the chosen actions, on carts that `models` move."""
    if getattr(config.plant, "prior_share", 1) == 0:
        if config.randomization:
            print_message("train", "note: plant.prior_share=0: no cart is drawn from randomization=")
        return
    encoders = config.hardware.encoders
    if unused := without_effect(
        draws, config.ranges, config.actions.motors, models, config.control_period, encoders
    ):
        chosen = (
            f"cart_friction={models.cart_friction}, pole_friction={models.pole_friction} and "
            f"actuator {models.actuator} with motor values {list(config.actions.motors)}"
        )
        print_message("train", f"note: randomization of {', '.join(unused)} has no effect with {chosen}")


def note_other_carts(config: TrainConfig, draws: Draws) -> None:
    """Print the parameters of the nominal cart that no drawn cart has: they lie outside absolute ranges."""
    nominal = config.nominal_cart
    identified = draws.limits() if isinstance(draws, IdentifiedCarts) else {}
    lines = config.ranges.items()
    ranges = {name: line.limits() for name, line in lines if not line.scales_nominal} | identified
    for name, (low, high) in ranges.items():
        value = nominal.get(name, low)
        close = ROUNDING * abs(value)
        if not low - close <= value <= high + close:
            setting = "posterior" if name in identified else name
            print_message(
                "train",
                f"note: the cart's {name} is {value:g}, but randomization.{setting} draws {low:g} to "
                f"{high:g}: the agent is evaluated on a cart that it does not learn on; give a "
                "randomization= that holds it (docs/randomization.md)",
            )


def nominal_env(config: TrainConfig) -> CartPoleEnv:
    """Return the environment of evaluations: the nominal cart with each pole in turn.

    Each pole has the same number of carts, so their number is rounded up.
    """
    poles = config.pole.each
    assert poles.choices is not None
    carts = len(poles.choices) * math.ceil(config.learning.evaluation_episodes / len(poles.choices))
    nominal = config.model_copy(update={"pole": poles, "randomization": {}})
    start = config.task.evaluation_start
    return simulated_env(nominal, config.plant.as_evaluated, carts, start, 0, config.compile)


def judge_agent(env: CartPoleEnv, agent: QAgent, policy: DrivingPolicy, seed: int) -> list[Episode]:
    """Return `judge` of the agent's greedy policy.

    The carts are on the CPU, whatever the device of the training: `policy` acts with a copy of the weights.
    """
    policy.load(as_weights(agent.greedy_policy()))
    return judge(env, policy, seed)


def judge(env: CartPoleEnv, policy: Policy, seed: int) -> list[Episode]:
    """Return episodes of a policy in a training with `seed`, from the same starts each time."""
    env.set_seed(evaluation_seed(seed))
    return run_batch(env, policy)


class TrainingMonitor(Monitor):
    """Monitor of one training in the run folder `folder`; a context manager around `Training.run`.

    `resumed_at` is the number of transitions from which a training is resumed: later records are removed.
    `view` shows the first episode of each evaluation.
    """

    def __init__(
        self, folder: Path, config: TrainConfig, resumed_at: int | None = None, view: WebView | None = None
    ) -> None:
        self.folder, self.config, self._view = folder, config, view
        self._settings = config.model_dump(mode="json")
        self._drawn_from = {str(path): file_hash(path) for path in config.drawn_from}
        self._logged = resumed_at or 0
        self._log = Loggers(config.logger, folder, None if resumed_at is None else resumed_at + 1)
        self._total = config.learning.at(config.control_period).collected_transitions
        self._bar = progress_bar(
            self._total, "transitions", initial=self._logged, unit_scale=True, mininterval=1.0
        )
        path = folder / HISTORY
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.history = [each for each in map(json.loads, lines) if each["transitions"] <= self._logged]
        self._write_history()

    def __enter__(self) -> "TrainingMonitor":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._bar.close()
        if error is not None:
            self._log.fail(error)
        with nullcontext() if error is None else suppress(OSError):  # which would hide the error
            self._log.close()

    def on_update(self, transitions: int, scalars: Scalars) -> None:
        """Log curves and advance the progress bar."""
        self._check_folder()
        self._log.scalars(scalars, transitions)
        self._advance(transitions)

    def on_evaluation(self, training: Training, episodes: Sequence[Episode], is_best: bool) -> None:
        """Log scores and sometimes pictures, and write the last and the best checkpoint."""
        self._check_folder()
        transitions, record = training.transitions, self._record(training, episodes)
        self.history.append(record)
        self._write_history()
        curves = {TAGS.get(key, key): value for key, value in record.items() if key != "transitions"}
        self._log.scalars({f"evaluation/{key}": value for key, value in curves.items()}, transitions)
        if len(self.history) % max(1, self.config.learning.evaluations // PICTURES) == 0:
            self._log_pictures(episodes[0], transitions)
        score = record[self.config.task.measure]
        if self._view:
            name = f"{transitions / 1e6:.2f} M transitions: mean {self.config.task.measure} {score:z.0f}"
            self._view.add(columns(name, episodes[0], self.config.task.x_max))
        agent = AgentCheckpoint(self._settings, training.agent.state_dict(), transitions, score)
        for name in (LAST, BEST) if is_best else (LAST,):
            save_agent(self.folder / CHECKPOINTS / name, agent)
        scored = f"{self.config.task.measure} {score:z.0f}"
        self._bar.set_postfix_str(scored)
        self._advance(transitions)
        if self._bar.disable:
            done, total = transitions / 1e6, self._total / 1e6
            print_message("train", f"{done:.2f} of {total:.2f} M transitions, {scored}")

    def on_checkpoint(self, training: Training) -> None:
        """Write the state to resume from."""
        self._log.flush()
        state, step = training.snapshot(), training.transitions
        save_training(self.folder, TrainingCheckpoint(self._settings, state, step, self._drawn_from))

    def randomization(self, plant: SimulatedPlant) -> None:
        """Log histograms of the current parameters of all carts."""
        for name in (*self.config.ranges, "pole_length"):
            values = getattr(plant.parameters, name).cpu().numpy()
            self._log.histogram(f"randomization/{name}", values, self._logged)

    def finished(self, summary: Mapping[str, Any]) -> None:
        """Log the settings beside the means of the last evaluation."""
        metrics = {key: value["mean"] for key in COMPARED if (value := summary[key]) is not None}
        self._log.hparams(self._settings, metrics)

    def _advance(self, transitions: int) -> None:
        self._bar.update(transitions - self._logged)
        self._logged = transitions

    def _check_folder(self) -> None:
        """Raise CheckpointError for a folder that is gone: what follows would be apart from the rest."""
        if not (self.folder / CONFIG).exists():
            raise CheckpointError(
                f"{self.folder} was moved or removed; cartpole-train resume=<its new place> continues it"
            )

    def _write_history(self) -> None:
        """Write the evaluations so far, a line each, all or none."""
        write_text(self.folder / HISTORY, "".join(json.dumps(record) + "\n" for record in self.history))

    def _record(self, training: Training, episodes: Sequence[Episode]) -> dict[str, float]:
        """Return the evaluation's line in the history."""
        metrics = [episode_metrics(episode, self.config.task.x_max) for episode in episodes]
        scores = [each[self.config.task.measure] for each in metrics]
        averaged = AVERAGED if metrics[0][GUARDED] is None else (*AVERAGED, GUARDED)
        means = {key: float(np.mean([each[key] for each in metrics])) for key in averaged}
        counts = {"transitions": training.transitions, "seconds": training.seconds}
        return {**counts, **means, "score_min": min(scores), "score_max": max(scores)}

    def _log_pictures(self, episode: Episode, transitions: int) -> None:
        half, length = self.config.task.x_max, self.config.pole.nominal.length
        title = f"After {transitions / 1e6:.1f} M transitions"
        self._log.figure("pictures/behaviour", behaviour(episode, title, half), transitions)
        self._log.animation("pictures/cart", gif(episode, length, half), transitions)
