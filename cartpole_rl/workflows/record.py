"""Run whole episodes as an evaluation does, and keep each as a file of its own.

An episode's file is there, whole, as soon as the episode ends; simulated carts run side by side, and end
together. An interruption costs at most the one under way.
"""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cartpole_rl.evaluation.recordings import LENGTH, write_recording
from cartpole_rl.learning.randomness import seed_everything
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import evaluated_agent, evaluated_env, evaluated_settings, use_threads
from cartpole_rl.workflows.config import CartPoleSettings, EvaluateConfig, RecordConfig, TrainConfig
from cartpole_rl.workflows.evaluate import count_text, driven
from cartpole_rl.workflows.origins import stored_origin
from cartpole_rl.workflows.person import confirm
from cartpole_rl.workflows.recordings import RECORDINGS
from cartpole_rl.workflows.repeating import repetition
from cartpole_rl.workflows.run_folder import write_config


def record(config: RecordConfig, folder: Path, baseline: TrainConfig | None = None) -> None:
    """Run episodes of the agent of `config.run` as `evaluate` does, and write each one as a recording.

    `baseline` describes the cart that the controller of run=lqr is made for; no agent needs it. Writes into
    `folder` config.yaml, provenance.json and recordings/episode_<number>.csv. Raises ConfigError and
    CheckpointError for settings, PlantError and LinkError for a cart that fails.
    """
    evaluation: EvaluateConfig = config
    if again := repetition(config):
        evaluation = again.config
    use_threads(evaluation.threads)
    seed_everything(evaluation.seed)
    agent = evaluated_agent(evaluation, baseline)
    settings = evaluated_settings(agent.training, evaluation)
    env = evaluated_env(settings, evaluation, prompt=tqdm.write, confirm=confirm)
    written = 0
    try:
        with closing(env):
            recorded = {**evaluation.model_dump(mode="json"), "recorded": settings.model_dump(mode="json")}
            write_config(folder, "record", recorded)
            for episode in driven(env, agent.policy, evaluation.episodes, again):
                path = folder / RECORDINGS / f"episode_{written:03d}.csv"
                write_recording(path, episode, facts(evaluation, settings, episode))
                written += 1
    finally:
        if written:
            print(f"{folder}/{RECORDINGS}/ holds {count_text(written)}")


def facts(config: EvaluateConfig, settings: CartPoleSettings, episode: Episode) -> dict[str, Any]:
    """What a recording's heading says of where it comes from; of a simulated cart, which one it was."""
    origin = stored_origin(episode.origin) if episode.origin else {}
    return {
        "plant": config.plant.kind,
        "pole": settings.pole.name,
        LENGTH: f"{2 * settings.pole.nominal.pole_com:.4f}" if one_pole(settings) else "",
        "control_period_s": settings.control_period,
        "run": config.run,
        **{name: json.dumps(values) for name, values in origin.items()},
    }


def one_pole(settings: CartPoleSettings) -> bool:
    """Whether all episodes have the same pole."""
    return settings.pole.choices is not None and len(settings.pole.choices) == 1
