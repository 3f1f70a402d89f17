"""Distill a trained agent into a smaller network, for a small processor."""

from pathlib import Path
from statistics import mean

from torch import nn

from cartpole_rl.checking import validated
from cartpole_rl.envs.build import simulated_env, with_fitted_guard
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.checkpoints import AgentCheckpoint, save_agent
from cartpole_rl.learning.distillation import Distillation
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.reporting.episodes import report_episodes
from cartpole_rl.run_folder import CHECKPOINTS, FIGURES, LAST, METRICS, write_config
from cartpole_rl.terminal import as_word, print_results, progress_bar, shown
from cartpole_rl.workflows.build import new_agent, provenance, trained_agent, use_threads
from cartpole_rl.workflows.config import DistillConfig, TrainConfig
from cartpole_rl.workflows.train import judge, nominal_env


def distill(config: DistillConfig, folder: Path) -> float:
    """Train a network of `config.hidden` to drive as the agent of `config.run` does; return its score.

    The carts are those of the agent's training. Writes into `folder` config.yaml, which has the provenance
    of the teacher as well, provenance.json, checkpoints/last.pt, metrics.json and figures/. Raises
    CheckpointError for a missing or damaged agent, ConfigError for impossible settings or a folder that
    already holds a run, LearningError if it diverges.
    """
    use_threads(config.threads)
    seed_everything(config.seed)
    teacher = trained_agent(config.run)
    training = student_settings(teacher.training, config)
    student = new_agent(training)
    carts, start = config.distillation.carts, training.task.start
    env = simulated_env(training, training.plant, carts, start, config.seed)
    settings, origin = training.model_dump(mode="json"), provenance(config.run)
    content = {**config.model_dump(mode="json"), "student": settings, "teacher": origin}
    write_config(folder, "distill", content)
    assert isinstance(teacher.policy, nn.Module)
    taught, driver = DrivingPolicy(teacher.policy), DrivingPolicy(student.greedy_policy())
    distillation = Distillation(config.distillation, taught, student, driver, env, config.seed)
    with progress_bar(config.distillation.rounds, "rounds") as progress:
        for loss in distillation.run():
            progress.set_postfix_str(f"loss {loss:.3f}", refresh=False)
            progress.update()
    episodes = judge(nominal_env(training), student.greedy_policy(), config.seed)
    score = mean([episode.total(training.task.measure) for episode in episodes])
    tuned_poles = [poles.model_dump(mode="json") for poles in teacher.known_poles[1:]]
    agent = AgentCheckpoint(settings, student.state_dict(), distillation.transitions, score, tuned_poles)
    save_agent(folder / CHECKPOINTS / LAST, agent)
    report_episodes(folder, episodes, training.plant.kind, training.pole, training.task)
    print(f"a network of {list(config.hidden)} hidden units scores {score:z.0f}")
    files = f"{METRICS}, {FIGURES}/ and {CHECKPOINTS}/"
    print_results(folder, files, f"cartpole-export {as_word('run', shown(folder))} format=c")
    return score


def student_settings(training: TrainConfig, config: DistillConfig) -> TrainConfig:
    """Return the settings of the teacher's training with the student's network. Raises ConfigError."""
    network = {"hidden": config.hidden, "recurrent": None, "kind": "dqn", "network": "mlp"}
    agent = training.agent.model_dump() | network
    own = {"agent": agent, "seed": config.seed, "compile": False, "device": "cpu"}
    values = {**training.model_dump(mode="json"), **own}
    return with_fitted_guard(validated(TrainConfig, values))
