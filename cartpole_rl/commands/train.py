"""cartpole-train: train an agent in randomized simulation.

    cartpole-train experiment=medium seed=1
    cartpole-train -m randomization=friction_3,friction_6,friction_12 seed=0,1
    cartpole-train resume=runs/train/2026-11-21_12-00-00
"""

import sys
from pathlib import Path
from typing import Any

from cartpole_rl.agents.dqn import seed_everything
from cartpole_rl.commands.application import application
from cartpole_rl.commands.build import new_agent, simulated_env, use_threads
from cartpole_rl.commands.config import TrainConfig, checked
from cartpole_rl.commands.monitor import TrainingMonitor
from cartpole_rl.commands.report import report
from cartpole_rl.commands.run_folder import write_config
from cartpole_rl.envs import CartPoleEnv
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.episodes import Policy, run_episodes
from cartpole_rl.learning.checkpoints import load_training
from cartpole_rl.learning.training import Training
from cartpole_rl.randomization import PoleSettings
from cartpole_rl.tasks.episode import Episode

EVALUATION_SEED = 10_000  # added to the seed, so that no evaluation starts where training did


@application("train", TrainConfig)
def main(config: TrainConfig, folder: Path) -> None:
    """Compose, build, train, report."""
    resumed = resumed_training(config)
    config = resumed[0] if resumed else config
    use_threads(config.threads)
    seed_everything(config.seed)
    env = simulated_env(config, config.plant, config.learning.carts, config.task.start, config.seed)
    evaluation_envs = nominal_envs(config)
    agent = new_agent(config)
    write_config(folder, config.model_dump(mode="json"))
    policy = agent.greedy_policy()
    with TrainingMonitor(folder, config, agent.state_dict, resumed[2] if resumed else None) as monitor:
        training = Training(
            config.learning,
            config.replay,
            config.optimizer,
            agent,
            env,
            lambda: evaluate(evaluation_envs, policy, config),
            monitor,
            config.seed,
            config.compile,
        )
        if resumed:
            training.restore(resumed[1])
        monitor.randomization(env.plant)
        training.run()
        episodes = evaluate(evaluation_envs, policy, config)
        metrics = report(folder, episodes, plant="simulated", pole=config.pole, x_max=config.task.x_max, history=monitor.history)
        monitor.finished(metrics)
    print(f"trained for {training.seconds:.0f} s; {folder}/metrics.json, figures/ and checkpoints/ are written")


def resumed_training(config: TrainConfig) -> tuple[TrainConfig, dict[str, Any], int] | None:
    """Config, state and frames of the training to go on with; None for a new one."""
    if config.resume is None:
        return None
    if extra := [word for word in sys.argv[1:] if "=" in word and not word.startswith(("resume=", "hydra."))]:
        raise ConfigError(f"resume={config.resume} goes on with that run's own config; leave out {', '.join(extra)}")
    state = load_training(Path(config.resume))
    return checked(TrainConfig, state["config"]), state, state["frames"]


def nominal_envs(config: TrainConfig) -> list[CartPoleEnv]:
    """Where the agent is judged: the nominal cart with each pole in turn, starting as the task says."""
    if config.pole.choices is not None:
        poles = [PoleSettings(choices={name: pole}) for name, pole in config.pole.choices.items()]
    else:
        poles = [config.pole]
    carts = max(1, config.learning.evaluation_episodes // len(poles))
    settings = [config.model_copy(update={"pole": pole, "randomization": {}}) for pole in poles]
    return [simulated_env(each, config.plant, carts, config.task.evaluation_start, 0) for each in settings]


def evaluate(envs: list[CartPoleEnv], policy: Policy, config: TrainConfig) -> list[Episode]:
    """Episodes of the greedy policy, from the same starts each time."""
    episodes: list[Episode] = []
    for env in envs:
        env.set_seed(config.seed + EVALUATION_SEED)
        episodes += run_episodes(env, policy, env.plant.carts)
    return episodes


if __name__ == "__main__":
    main()
