"""Fine-tune a trained agent on the cart that it drives.

Three stages: episodes without exploration (before), episodes to learn from (tune), episodes without
exploration (after). A separate process drives the cart while this one learns. Each finished episode is on
disk before the next one starts: an interruption costs at most the current one.
"""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

from torch import nn

from cartpole_rl.checking import checked
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.errors import CheckpointError
from cartpole_rl.evaluation.driver import Driver
from cartpole_rl.evaluation.publishing import followed
from cartpole_rl.evaluation.snapshots import Memory
from cartpole_rl.files import claimed, write_bytes
from cartpole_rl.learning.checkpoint_files import find_agent
from cartpole_rl.learning.checkpoints import load_agent
from cartpole_rl.learning.settings import RayLearnerSettings
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.plants.serial.faults import Confirm
from cartpole_rl.plants.settings import EmulatedSettings
from cartpole_rl.reporting.tensorboard import TensorBoardLog
from cartpole_rl.run_files import CHECKPOINTS, PROVENANCE, START
from cartpole_rl.workflows.agents import new_agent, trained_agent
from cartpole_rl.workflows.build import (
    evaluated_env,
    evaluated_settings,
    guard_note,
    is_real_time,
    use_threads,
)
from cartpole_rl.workflows.checks import check_finetuning
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig
from cartpole_rl.workflows.finetuning_cart import DrivenCart, yielding_to
from cartpole_rl.workflows.finetuning_files import FinetuningFiles
from cartpole_rl.workflows.finetuning_learner import check_simulation
from cartpole_rl.workflows.finetuning_session import LocalSession, TunedAgent
from cartpole_rl.workflows.live import LiveView, view_title
from cartpole_rl.workflows.loading import recorded_settings
from cartpole_rl.workflows.person import as_word, confirm, print_message
from cartpole_rl.workflows.ray_learner.session import RaySession, learner_link
from cartpole_rl.workflows.resuming import resumed
from cartpole_rl.workflows.run_folder import AGENT_HASH, file_hash, recorded_provenance, write_config
from cartpole_rl.workflows.trained_poles import other_pole


def finetune(config: FinetuneConfig, folder: Path, new_learner: bool = False) -> None:
    """Fine-tune the agent of `config.run` on the cart of `config.plant`, or resume the run in `folder`.

    A resumed run uses its own settings and the agent that it started from; with `new_learner`,
    `config.learner` replaces its learner.

    Writes config.yaml, provenance.json, recordings/, TensorBoard events, comparison.json (before and after),
    metrics.json, figures/ and checkpoints/last.pt with the better of both policies; until the end also
    checkpoints/start.pt and resume.pt. Prints both scores. Raises ConfigError and CheckpointError before the
    cart moves, PlantError and LinkError for a cart that fails, LearningError if learning diverges.
    """
    checkpoint = resumed("finetune", config.resume, folder)
    if checkpoint:
        learner = {"learner": config.learner.model_dump()} if new_learner else {}
        values = {**checkpoint.config, "resume": config.resume, **learner}
        config = recorded_settings(FinetuneConfig, values, f"resume={config.resume}")
    files = FinetuningFiles(folder, config)
    run = started_from(files) if checkpoint else check_finetuning(config)
    use_threads(config.threads)
    seed_everything(config.seed)
    agent = trained_agent(run)
    training = agent.training
    evaluation = evaluation_config(config)
    settings = evaluated_settings(training, evaluation)
    if line := other_pole(agent.known_poles, settings.pole, isinstance(config.plant, EmulatedSettings)):
        print_message("finetune", line)
    if line := guard_note(training, evaluation, settings):
        print_message("finetune", line)
    if not isinstance(config.learner, RayLearnerSettings):  # whose machine has the files
        check_simulation(training)
    with claimed(folder):
        start = find_agent(run)
        content = config.model_dump(mode="json")
        write_config(folder, "finetune", content, resumed=checkpoint is not None, agent=start)
        if run != files.start:
            write_bytes(files.start, start.read_bytes())
        if not checkpoint:
            files.save({}, 0)
        tuned = TunedAgent(training, load_agent(start), checkpoint)
        live = LiveView(view_title(config.plant), config.view)
        make_env = partial(driven_env, settings, evaluation, live.memory)  # called with `confirm`
        real_time = is_real_time(config.plant, config.emulator)
        with (
            live,
            TensorBoardLog(folder) as log,
            learner_link(files, tuned, evaluation) as link,
            Driver(make_env, partial(greedy_network, training), real_time, confirm) as driver,
            yielding_to(driver, link is None) if real_time else nullcontext(),
        ):
            cart = DrivenCart(driver, files, log)
            if link is None:
                LocalSession(files, cart, tuned, settings).run()
            else:
                RaySession(files, cart, tuned, settings, link).run()


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


def driven_env(
    settings: CartPoleSettings, evaluation: EvaluateConfig, memory: Memory | None, confirm: Confirm
) -> CartPoleEnv:
    """Return the environment over the cart, in the process that drives it."""
    return followed(evaluated_env(settings, evaluation, print, confirm), memory)


def evaluation_config(config: FinetuneConfig) -> EvaluateConfig:
    """Return the settings that the cart is driven with."""
    shared = config.model_dump(include={"run", "plant", "emulator", "seed", "label", "threads"})
    episodes = config.evaluation_episodes
    return checked(EvaluateConfig, {**shared, "episodes": episodes, "randomization": {}, "parameters": None})


def greedy_network(training: TrainConfig) -> nn.Module:
    """Return the network that drives, for weights of `as_weights`."""
    return new_agent(training).greedy_policy()
