"""cartpole-record: run whole episodes as cartpole-evaluate does, and keep each as a file of its own.

cartpole-record run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 episodes=5
cartpole-record run=runs/train/2026-11-21_12-00-00 plant=emulated
cartpole-record run=lqr pole=large

An episode's file is there, whole, as soon as the episode ends; simulated carts run side by side, and end
together. Ctrl-C or a pulled cable cost at most the one under way.
"""

from contextlib import closing
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cartpole_rl.commands.application import application
from cartpole_rl.commands.build import evaluated_agent, evaluated_env, evaluated_settings, use_threads
from cartpole_rl.commands.config import CartPoleSettings, EvaluateConfig
from cartpole_rl.commands.evaluate import count_text, with_progress
from cartpole_rl.commands.run_folder import write_config
from cartpole_rl.evaluation.recordings import write_recording
from cartpole_rl.learning.randomness import seed_everything

RECORDINGS = "recordings"
RECORDING = ("record", "identify", "finetune")  # commands whose runs hold recordings
LENGTH = "pole_length_m"  # in a recording's heading


class RecordConfig(EvaluateConfig):
    """cartpole-record: what is run is said as for an evaluation."""


@application("record", RecordConfig)
def main(config: RecordConfig, folder: Path) -> None:
    """Load, build, run, write each."""
    use_threads(config.threads)
    seed_everything(config.seed)
    agent = evaluated_agent(config)
    settings = evaluated_settings(agent.training, config)
    env = evaluated_env(settings, config, prompt=tqdm.write)
    written = 0
    try:
        with closing(env):
            recorded = {**config.model_dump(mode="json"), "recorded": settings.model_dump(mode="json")}
            write_config(folder, "record", recorded)
            for episode in with_progress(env, agent.policy, config.episodes):
                path = folder / RECORDINGS / f"episode_{written:03d}.csv"
                write_recording(path, episode, facts(config, settings))
                written += 1
    finally:
        if written:
            print(f"{folder}/{RECORDINGS}/ holds {count_text(written)}")


def facts(config: RecordConfig, settings: CartPoleSettings) -> dict[str, Any]:
    """What a recording's heading says of where it comes from."""
    return {
        "plant": config.plant.kind,
        "pole": settings.pole.name,
        LENGTH: f"{2 * settings.pole.nominal.pole_com:.4f}" if one_pole(settings) else "",
        "control_period_s": settings.control_period,
        "run": config.run,
    }


def one_pole(settings: CartPoleSettings) -> bool:
    """Whether all episodes have the same pole."""
    return settings.pole.choices is not None and len(settings.pole.choices) == 1


if __name__ == "__main__":
    main()
