"""Run whole episodes of a trained agent, in simulation or on a cart, and report what they are worth."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.evaluation.episodes import Policy, run_batch, run_episodes
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.simulated import NOISE_PARAMETERS, SimulatedPlant
from cartpole_rl.reporting.table import interval_text, table
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import evaluated_agent, evaluated_env, evaluated_settings, use_threads
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig
from cartpole_rl.workflows.person import confirm
from cartpole_rl.workflows.repeating import Repetition, repetition
from cartpole_rl.workflows.report import report
from cartpole_rl.workflows.run_folder import METRICS, write_config

SHOWN = {
    "score": "score (6.2)",
    "score_upright": "score upright (6.1)",
    "time_to_upright_s": "time to upright, s",
    "upright_fraction": "share of time upright",
    "rms_angle_rad": "RMS angle while upright, rad",
    "rms_position_m": "RMS position while upright, m",
    "min_track_margin_m": "nearest to the track's end, m",
}


def evaluate(config: EvaluateConfig, folder: Path, baseline: TrainConfig | None = None) -> None:
    """Run episodes of the agent of `config.run`, in simulation or on a cart.

    `baseline` describes the cart that the controller of run=lqr is made for; no agent needs it. Writes into
    `folder` config.yaml, provenance.json, metrics.json and figures/, also after an interruption, and prints
    the scores. Raises ConfigError and CheckpointError for settings, PlantError and LinkError for a cart that
    fails.
    """
    if again := repetition(config):
        config = again.config
    use_threads(config.threads)
    seed_everything(config.seed)
    agent = evaluated_agent(config, baseline)
    settings = evaluated_settings(agent.training, config)
    env = evaluated_env(settings, config, prompt=tqdm.write, confirm=confirm)
    episodes: list[Episode] = []
    try:
        with closing(env):
            recorded = {**config.model_dump(mode="json"), "evaluated": settings.model_dump(mode="json")}
            write_config(folder, "evaluate", recorded)
            for episode in driven(env, agent.policy, config.episodes, again):
                episodes.append(episode)
    finally:  # what a broken link or Ctrl-C leaves is worth its figures
        if episodes:
            plant, x_max = config.plant.kind, settings.task.x_max
            link = link_figures(env)
            summary = report(folder, episodes, plant, settings.pole, x_max, link)
            print(score_table(summary, f"plant={plant}, {count_text(len(episodes))}"))
            for line in cut_off(episodes):
                print(line)
            if again:
                print(compared(again, episodes[0]))
            if link.get("latency_override"):
                print(f"latency as measured, for cartpole-train: '{link['latency_override']}'")
            print(f"{folder}/{METRICS} and figures/ are written")


def cut_off(episodes: Sequence[Episode]) -> Iterator[str]:
    """A warning for each reason that ended episodes from outside the task: their scores are in the means."""
    for ending in (Ending.LINK, Ending.FAULT, Ending.NON_FINITE):
        if count := sum(episode.ended_by == ending for episode in episodes):
            yield f"warning: {count} of {count_text(len(episodes))} ended early by {ending} (docs/safety.md)"


def driven(env: CartPoleEnv, policy: Policy, episodes: int, again: Repetition | None) -> Iterator[Episode]:
    """The episode that is repeated, or `episodes` new ones."""
    return repeated(env, policy, again) if again else with_progress(env, policy, episodes)


def repeated(env: CartPoleEnv, policy: Policy, again: Repetition) -> Iterator[Episode]:
    """The episode that is repeated."""
    assert isinstance(env.plant, SimulatedPlant)
    env.plant.start_from(again.origin.state)
    yield run_batch(env, policy)[again.row]


def with_progress(env: CartPoleEnv, policy: Policy, episodes: int) -> Iterator[Episode]:
    """The episodes as they end, with a progress bar that shows each one's score."""
    with tqdm(total=episodes, unit=" episodes") as progress:
        for episode in run_episodes(env, policy, episodes):
            progress.set_postfix_str(f"score {episode.score.sum():.0f}", refresh=False)
            progress.update()
            yield episode


def compared(again: Repetition, episode: Episode) -> str:
    """Say how the score compares with that of the episode which was driven again."""
    repeat, score = again.config.repeat, float(episode.score.sum())
    then = f"episode {repeat.episode} of {repeat.run} had score {again.score:.1f}"
    if by_chance := left_to_chance(again):
        chance = ", ".join(by_chance)
        return f"{then}, now {score:.1f}: {chance} is left to chance, so it cannot be repeated exactly"
    return f"{then}, now {'exactly the same' if score == again.score else f'{score:.1f}'}"


def left_to_chance(again: Repetition) -> list[str]:
    """The parameters of the cart that keep its episode from being driven exactly alike."""
    return [name for name in NOISE_PARAMETERS if again.origin.parameters[name] != 0]


def link_figures(env: CartPoleEnv) -> dict[str, Any]:
    """Frames lost, spoilt and late on the wire, none where there is no wire; what it says of the latency."""
    if not isinstance(env.plant, SerialPlant):
        return {"late_ticks": 0, "lost_frames": 0, "bad_frames": 0}
    seen = env.plant.cart.statistics
    return {
        "late_ticks": seen.late_ticks,
        "lost_frames": seen.lost_frames,
        "bad_frames": seen.bad_frames,
        "latency_override": seen.latency_override(),
    }


def score_table(summary: Mapping[str, Any], heading: str) -> str:
    """The figures that a person asks for first."""
    rows = [
        {"figure": label, "mean": interval_text(value["mean"], value["low"], value["high"])}
        for key, label in SHOWN.items()
        if (value := summary[key]) is not None
    ]
    return table(rows, {"figure": heading, "mean": "mean"})


def count_text(episodes: int) -> str:
    """One in the singular: "1 episode", "20 episodes"."""
    return f"{episodes} episode{'s' if episodes > 1 else ''}"
