"""Fine-tune a trained agent on the cart that it drives.

Three stages: episodes without exploration (before), episodes to learn from (tune), episodes without
exploration (after). A separate process drives the cart while this one learns. Each finished episode is on
disk before the next one starts: an interruption costs at most the current one.
"""

import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from torch import nn

from cartpole_rl.checking import validated
from cartpole_rl.composition import key_of
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.evaluation.driver import Driver
from cartpole_rl.evaluation.snapshots import Memory, followed
from cartpole_rl.files import claimed, write_bytes
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TrainingCheckpoint,
    forget_training,
    load_agent,
    load_training,
    save_agent,
)
from cartpole_rl.learning.dqn import Training
from cartpole_rl.learning.settings import RayLearnerSettings
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.plants.serial.preparation import Confirm
from cartpole_rl.reporting.episodes import report_episodes, summarized
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.reporting.texts import SCORES, count_text, cut_off, score_table
from cartpole_rl.reporting.web_view import chosen_view
from cartpole_rl.run_folder import (
    AGENT_HASH,
    CHECKPOINTS,
    COMPARISON,
    LAST,
    METRICS,
    PROVENANCE,
    RECORDINGS,
    START,
    file_hash,
    find_agent,
    recorded_provenance,
    write_config,
    write_json,
)
from cartpole_rl.terminal import (
    as_word,
    confirm,
    print_loop_time,
    print_message,
    print_results,
    shown,
    waiting,
)
from cartpole_rl.workflows.build import (
    driving_notes,
    evaluated_env,
    evaluated_settings,
    new_agent,
    trained_agent,
    use_threads,
)
from cartpole_rl.workflows.checks import check_finetuning, check_resumable, check_tools
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig, recorded_settings
from cartpole_rl.workflows.finetuning_cart import FinetuningCart, FinetuningFiles, Stage, yielding_to
from cartpole_rl.workflows.finetuning_learner import CartLearner, TunedAgent, check_simulation, check_warmup
from cartpole_rl.workflows.poles import plant_words
from cartpole_rl.workflows.ray_learner import LearnerLink, LearnerTask, Offer

NAME = "learner"  # in a checkpoint: the name of a learner of Ray
POLL = 0.1  # s between two looks for weights

show = partial(print_message, "finetune")


@waiting("preparing")
def finetune(config: FinetuneConfig, folder: Path, words: Sequence[str] = ()) -> None:
    """Fine-tune the agent of `config.run` on the cart of `config.plant`, or resume the run in `folder`.

    A resumed run uses its own settings and the agent that it started from, and of `config` what the `words`
    of the command line give.

    Writes config.yaml, provenance.json, recordings/, TensorBoard events, comparison.json (before and after),
    metrics.json, figures/, checkpoints/last.pt with the better of both policies, and before.pt or after.pt
    with the other one; until the end also checkpoints/start.pt and resume.pt. Prints both scores. Raises
    ConfigError, CheckpointError and RecordingError before the cart moves, PlantError and LinkError for a cart
    that fails, LearningError if learning diverges.
    """
    checkpoint = None
    if config.resume is not None:
        check_resumable("finetune", config.resume, folder)
        checkpoint = load_training(Path(config.resume), FINETUNING_FORMAT)
        values = overlaid(checkpoint.config, config.model_dump(mode="json"), words)
        config = recorded_settings(FinetuneConfig, values, f"resume={config.resume}")
        check_tools(config)
    files = FinetuningFiles(folder, config)
    if checkpoint:
        files.check(checkpoint.step)
    run = started_from(files) if checkpoint else check_finetuning(config)
    use_threads(config.threads)
    seed_everything(config.seed)
    agent = trained_agent(run)
    training, kind = agent.training, agent.training.agent.kind
    if not (isinstance(kind.item, type) and issubclass(kind.item, QAgent)):
        raise ConfigError(f"run={run}: fine-tuning trains Q-networks, this is an agent of agent.kind={kind}")
    if kind.learner.item is not Training:
        raise ConfigError(
            f"run={run}: fine-tuning has a learner of its own, and so has agent.kind={kind}; give an agent "
            "that learning.dqn.Training trained"
        )
    evaluation = evaluation_config(config)
    settings = evaluated_settings(training, evaluation)
    for note in driving_notes(training, agent.known_poles, evaluation, settings):
        show(note)
    if not checkpoint:
        check_warmup(config, training)
    if not isinstance(config.learner, RayLearnerSettings):  # whose machine has the files
        check_simulation(training)
    with claimed(folder):
        start = find_agent(run).read_bytes()  # once: its training may go on
        content = config.model_dump(mode="json")
        write_config(folder, "finetune", content, resumed=checkpoint is not None, agent=start)
        if run != files.start:
            write_bytes(files.start, start)
        if not checkpoint:
            files.save({}, 0)
        drive_all(files, TunedAgent(training, load_agent(files.start), checkpoint), settings, evaluation)
        forget_training(folder)
        files.start.unlink(missing_ok=True)


def drive_all(
    files: FinetuningFiles, tuned: TunedAgent, settings: CartPoleSettings, evaluation: EvaluateConfig
) -> None:
    """Drive the three stages, and learn in the second."""
    config, length = files.config, settings.pole.nominal.length
    live = chosen_view(config.plant.title, config.view, length)
    real_time = config.plant.is_real_time(config.emulator)
    make_env = partial(driven_env, settings, evaluation, live.memory)  # called with `confirm`
    make_policy = partial(greedy_network, tuned.training)
    with (
        live,
        TensorBoardLog(files.folder) as log,
        link_to_learner(files, tuned, evaluation) as link,
        Driver(make_env, make_policy, real_time, confirm) as driver,
        yielding_to(driver, link is None) if real_time else nullcontext(),
    ):
        cart = FinetuningCart(driver, files, log, settings.task.measure)
        cart.evaluate(Stage.BEFORE, tuned.first_weights)
        if link is None:
            learn_here(cart, tuned, settings)
        else:
            learn_there(link, cart, tuned)
        cart.evaluate(Stage.AFTER, tuned.weights)
        compare(cart, tuned, settings)


def overlaid(recorded: Mapping[str, Any], given: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Return the `recorded` settings of a run with those `given` that the `words` of a command line name.

    A learner of the same kind keeps its other settings.
    """
    values = {**recorded, "resume": given["resume"]}
    for word in words:
        group, _, name = key_of(word).partition(".")
        if name:
            values[group] = {**values[group], name: given[group][name]}
        elif word != f"learner={values.get('learner', {}).get('kind')}":
            values[group] = given[group]
    return values


def started_from(files: FinetuningFiles) -> Path:
    """Return the agent that an interrupted fine-tuning started from: its copy, or that of `run` if unchanged.

    Raises CheckpointError, ConfigError.
    """
    if files.start.exists():
        return files.start
    run = check_finetuning(files.config)
    if file_hash(find_agent(run)) != recorded_provenance(files.folder).get(AGENT_HASH):
        raise CheckpointError(
            f"resume={files.folder}: it holds no {CHECKPOINTS}/{START}, and by {PROVENANCE} the agent of "
            f"run={run} is not the one that it started from; cartpole-finetune "
            f"{as_word('run', run)} starts anew"
        )
    return run


def evaluation_config(config: FinetuneConfig) -> EvaluateConfig:
    """Return the settings that the cart is driven with."""
    shared = config.model_dump(include={"run", "plant", "emulator", "seed", "label", "threads"})
    episodes = config.evaluation_episodes
    return validated(
        EvaluateConfig, {**shared, "episodes": episodes, "randomization": {}, "parameters": None}
    )


def driven_env(
    settings: CartPoleSettings, evaluation: EvaluateConfig, memory: Memory | None, confirm: Confirm
) -> CartPoleEnv:
    """Return the environment over the cart, in the process that drives it."""
    return followed(evaluated_env(settings, evaluation, show, confirm), memory)


def greedy_network(training: TrainConfig) -> nn.Module:
    """Return the network that drives, for weights of `as_weights`."""
    return new_agent(training).greedy_policy()


@contextmanager
def link_to_learner(
    files: FinetuningFiles, tuned: TunedAgent, evaluation: EvaluateConfig
) -> Iterator[LearnerLink | None]:
    """Connect to the learner of learner=ray; yield None if the learner is this process.

    A resumed run whose episodes were all learned from needs no learner either. Raises LearnerError.
    """
    settings = files.config.learner
    if not isinstance(settings, RayLearnerSettings) or tuned.learned >= files.config.episodes:
        yield None
        return
    name = tuned.state.setdefault(NAME, secrets.token_hex(8))
    save_newest(files, tuned)
    config, driving = files.config.model_dump(mode="json"), evaluation.model_dump(mode="json")

    def task() -> LearnerTask:
        state = {"agent": {key: weight.clone() for key, weight in tuned.agent.state_dict().items()}}
        return LearnerTask(name, driving, tuned.start, TrainingCheckpoint(config, state, tuned.learned))

    with closing(LearnerLink(settings, files.folder, files.learned_from, task, show)) as link:
        link.connect()
        yield link


def learn_here(cart: FinetuningCart, tuned: TunedAgent, settings: CartPoleSettings) -> None:
    """Drive and learn at the same time, episode by episode; what is on disk is not driven again."""
    files, config, learned = cart.files, cart.config, tuned.learned
    if learned >= config.episodes:
        return
    learner = CartLearner(config, tuned.training, settings, tuned.agent)
    recorded = files.learned_from()[: config.evaluation_episodes + learned]
    if "replay" in tuned.state:
        learner.restore(recorded, tuned.state)
    else:  # a new run, or one whose learner was on another machine
        cart.log_learning(learner.start(recorded, learned), learned)
    for number in range(learned, config.episodes):
        if drives := number >= files.count(Stage.TUNE):
            cart.start_tuning(number, tuned.weights)
        curves = learner.round()
        if drives:
            cart.finish(Stage.TUNE, number)
        learner.add(files.episode(Stage.TUNE, number))
        cart.log_learning(curves, number + 1)
        files.save(learner.snapshot(), number + 1)


def learn_there(link: LearnerLink, cart: FinetuningCart, tuned: TunedAgent) -> None:
    """Drive each episode that is not on disk with the weights for it, and wait for the last weights.

    Raises LearningError if learning failed.
    """
    for number in range(cart.files.count(Stage.TUNE), cart.config.episodes):
        wait_for_weights(link, cart, tuned, number, link.settings.episodes_ahead)
        cart.start_tuning(number, tuned.weights)
        cart.finish(Stage.TUNE, number)
    wait_for_weights(link, cart, tuned, cart.config.episodes, ahead=0)
    link.finish()


def wait_for_weights(
    link: LearnerLink, cart: FinetuningCart, tuned: TunedAgent, number: int, ahead: int
) -> None:
    """Wait for weights that were learned from `number` episodes, while the cart stands still.

    Weights from up to `ahead` episodes fewer do while the learner is lost.
    """
    waits = False
    while True:
        for news in link.poll():
            if isinstance(news, Offer):
                take(news, cart.files, tuned)
            elif news.learned > tuned.logged:  # a learner that outlived its session sends all of its news
                cart.log_learning(news.scalars, news.learned)
                tuned.logged = news.learned
        lacking = number - tuned.learned
        if lacking <= 0:
            return
        if link.is_lost and lacking <= ahead:
            show(f"tune {number + 1} is driven with weights from {count_text(tuned.learned)}")
            return
        if link.is_lost and not waits:
            show("the cart waits for the learner; Ctrl-C stops, resume= continues")
            waits = True
        time.sleep(POLL)


def take(offer: Offer, files: FinetuningFiles, tuned: TunedAgent) -> None:
    """Take weights that arrived, if they are newer than the present ones, of this network, and finite."""
    if not tuned.learned < offer.version <= files.config.episodes:
        return
    try:
        tuned.replace(offer.weights, f"version {offer.version} of the learner's weights")
    except CheckpointError as error:
        show(f"{error}; the earlier weights are kept")
        return
    tuned.learned = offer.version
    save_newest(files, tuned)


def save_newest(files: FinetuningFiles, tuned: TunedAgent) -> None:
    """Write the checkpoint to resume from: the newest weights, and the learner that has all else."""
    files.save({"agent": tuned.agent.state_dict(), NAME: tuned.state[NAME]}, tuned.learned)


def compare(cart: FinetuningCart, tuned: TunedAgent, settings: CartPoleSettings) -> None:
    """Keep the better policy; write both policies and the results, and print the results."""
    files, config, task = cart.files, cart.config, settings.task
    episodes = {stage: files.episodes(stage) for stage in Stage}
    summaries, track = {}, settings.nominal_cart["track_half_length"]
    for stage in (Stage.BEFORE, Stage.AFTER):
        summary, listed = summarized(episodes[stage], track)
        summaries[stage] = {**summary, "episodes": listed}
    scores = {stage: each[task.measure]["mean"] for stage, each in summaries.items()}
    kept = Stage.AFTER if scores[Stage.AFTER] >= scores[Stage.BEFORE] else Stage.BEFORE
    folder, link = files.folder, cart.link_summary()
    other = Stage.BEFORE if kept is Stage.AFTER else Stage.AFTER
    names = {other: f"{other}.pt", kept: LAST}
    for stage, name in names.items():
        save_agent(folder / CHECKPOINTS / name, tuned.checkpoint(stage, scores[stage], settings.pole))
    report_episodes(folder, episodes[kept], config.plant.kind, settings.pole, task, track, link)
    write_json(folder / COMPARISON, {**summaries, "kept": kept})
    for stage, summary in summaries.items():
        print(score_table(summary, f"{stage}, {count_text(len(episodes[stage]))}"))
    for line in cut_off([episode for driven in episodes.values() for episode in driven]):
        print(line)
    print_loop_time(link.get("latency_override"))
    print(
        f"kept: the policy {kept} fine-tuning, by its {SCORES[task.measure]}; the other one is "
        f"{CHECKPOINTS}/{names[other]}"
    )
    written = f"{METRICS}, {COMPARISON}, {CHECKPOINTS}/{LAST} and {RECORDINGS}/"
    words = plant_words(config.plant, config.emulator)
    print_results(folder, written, f"cartpole-evaluate {as_word('run', shown(folder))} {words}")
