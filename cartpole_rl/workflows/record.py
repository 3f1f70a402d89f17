"""Drive whole episodes as an evaluation does, and write a recording of each.

A recording is written as soon as its episode ends, so that an interruption loses only the current episode.
Simulated carts run side by side, and end together.
"""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from cartpole_rl.envs.settings import CartPoleSettings
from cartpole_rl.evaluation.recordings import LENGTH, stored_origin, write_recording
from cartpole_rl.reporting.texts import count_text, guard_text
from cartpole_rl.run_folder import RECORDINGS, write_config
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import as_word, shown
from cartpole_rl.workflows.build import RECORDED
from cartpole_rl.workflows.config import EvaluateConfig, RecordConfig
from cartpole_rl.workflows.episodes import Evaluation, prepared


def record(config: RecordConfig, folder: Path) -> None:
    """Run episodes of the agent of `config.run` as `evaluate` does, and write each one as a recording.

    Writes into `folder` config.yaml, provenance.json and recordings/episode_<number>.csv. Raises ConfigError
    and CheckpointError for settings, PlantError and LinkError for a cart that fails.
    """
    evaluation = prepared(config)
    episodes: dict[Path, Episode] = {}
    try:
        with closing(evaluation.env):
            evaluation.print_notes("record")
            settings = agents_settings(evaluation).model_dump(mode="json")
            content = {**evaluation.config.model_dump(mode="json"), RECORDED: settings}
            write_config(folder, "record", content, agent=evaluation.agent_content)
            for episode in evaluation.episodes():
                path = folder / RECORDINGS / f"episode_{len(episodes):03d}.csv"
                episodes[path] = episode
                write_recording(path, episode, heading(evaluation.config, evaluation.settings, episode))
    finally:
        if kept := [episode for path, episode in episodes.items() if path.exists()]:
            held = f"{count_text(len(kept))}{guard_text(*kept)}"
            print(f"{shown(folder)}/{RECORDINGS}/ holds {held}; next:")
            print(f"cartpole-replay {as_word('from', shown(folder))}")


def agents_settings(evaluation: Evaluation) -> CartPoleSettings:
    """Return the settings of an episode with the pole as the agent knows it, where that is on the cart."""
    settings, driven = evaluation.settings, evaluation.settings.pole.nominal
    own = [poles for poles in evaluation.known_poles if poles.is_single and poles.includes(driven)]
    on_port = evaluation.config.plant.is_on_port and own
    return settings.model_copy(update={"pole": own[-1]}) if on_port else settings


def heading(config: EvaluateConfig, settings: CartPoleSettings, episode: Episode) -> dict[str, Any]:
    """Return the heading of a recording: the run, and the simulated cart with its initial state."""
    origin = stored_origin(episode.origin) if episode.origin else {}
    length = episode.pole_length or config.plant.known_pole_length(config.emulator)  # stated for a real cart
    if length is None and settings.pole.is_single:
        length = settings.pole.nominal.length
    return {
        "plant": config.plant.kind,
        "pole": settings.pole.name,
        LENGTH: "" if length is None else f"{length:.4f}",
        "control_period_s": settings.control_period,
        "run": config.run,
        **{name: json.dumps(values) for name, values in origin.items()},
    }
