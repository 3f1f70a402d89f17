"""cartpole-evaluate: run whole episodes of a trained agent, in simulation or on a cart.

    cartpole-evaluate run=runs/train/2026-11-21_12-00-00 episodes=20
    cartpole-evaluate run=runs/train/2026-11-21_12-00-00 plant=emulated emulator.latency=0.02
    cartpole-evaluate run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cartpole_rl.agents.dqn import seed_everything
from cartpole_rl.commands.application import application
from cartpole_rl.commands.build import evaluated_env, evaluated_settings, trained_agent, use_threads
from cartpole_rl.commands.config import EvaluateConfig
from cartpole_rl.commands.report import METRICS, report
from cartpole_rl.commands.run_folder import write_config
from cartpole_rl.envs import CartPoleEnv
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.plants.serial import SerialPlant
from cartpole_rl.reporting.table import interval_text, table
from cartpole_rl.tasks.episode import Episode


@application("evaluate", EvaluateConfig)
def main(config: EvaluateConfig, folder: Path) -> None:
    """Load, build, run, report."""
    use_threads(config.threads)
    seed_everything(config.seed)
    agent = trained_agent(config.run)
    settings = evaluated_settings(agent, config)
    env = evaluated_env(settings, config, prompt=tqdm.write)
    try:
        write_config(folder, {**config.model_dump(mode="json"), "agent": settings.model_dump(mode="json")})
        progress = tqdm(run_episodes(env, agent.policy, config.episodes), total=config.episodes, unit=" episodes")
        episodes = list(with_scores(progress))
        link = link_figures(env)
    finally:
        env.close()
    report(folder, episodes, config.plant.kind, settings.pole, settings.task.x_max, link)
    print(score_table(folder))
    print(f"{folder}/{METRICS} and figures/ are written")


def with_scores(progress: Any) -> Iterator[Episode]:
    """The episodes, each one's score shown on the progress bar."""
    for episode in progress:
        progress.set_postfix_str(f"score {episode.score.sum():.0f}")
        yield episode


def link_figures(env: CartPoleEnv) -> dict[str, int]:
    """Frames lost, spoilt and late on the wire; none where there is no wire."""
    if not isinstance(env.plant, SerialPlant):
        return {"late_ticks": 0, "lost_frames": 0, "bad_frames": 0}
    seen = env.plant.cart.statistics
    return {"late_ticks": seen.late_ticks, "lost_frames": seen.lost_frames, "bad_frames": seen.bad_frames}


def score_table(folder: Path) -> str:
    """The figures of metrics.json that a person asks for first."""
    import json

    metrics = json.loads((folder / METRICS).read_text())
    rows = [
        {"figure": label, "mean": interval_text(value["mean"], value["low"], value["high"])}
        for key, label in SHOWN.items()
        if (value := metrics[key]) is not None
    ]
    return table(rows, {"figure": f"plant={metrics['plant']}, {len(metrics['episodes'])} episodes", "mean": "mean"})


SHOWN = {
    "score": "score (6.2)",
    "score_upright": "score upright (6.1)",
    "time_to_upright_s": "time to upright, s",
    "upright_fraction": "share of time upright",
    "rms_angle_rad": "RMS angle while upright, rad",
    "rms_position_m": "RMS position while upright, m",
    "min_track_margin_m": "nearest to the track's end, m",
}


if __name__ == "__main__":
    main()
