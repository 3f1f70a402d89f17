"""Drive the simulated cart with recorded motor values, and report its errors against the recording.

The simulated cart is reset to the measured state every `restart` seconds: over a whole episode any two carts
diverge.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.checks import check_same_encoders, shared_period
from cartpole_rl.identification.prediction import (
    LEAD,
    Replayed,
    all_errors,
    away_from_upright,
    errors_at,
    replay,
)
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import lead_periods
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.episodes import columns
from cartpole_rl.reporting.predictions import REPORTED_TIMES, error_table, replay_figure
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.reporting.web_view import WebView
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.rig.parameters import check_names, check_values
from cartpole_rl.run_folder import FIGURES, recorded_config, recordings, write_config, write_json
from cartpole_rl.terminal import as_word, print_message, print_results, shown, words_given
from cartpole_rl.workflows.build import recorded_cart
from cartpole_rl.workflows.checks import note_other_numbers
from cartpole_rl.workflows.config import ReplayConfig, TrainConfig, load_settings, recorded_settings
from cartpole_rl.workflows.poles import chosen_pole

REPLAY, FIGURE = "replay.json", f"{FIGURES}/replay.png"
GROUPS = ("cart", "cart_friction", "pole_friction")


def replay_recordings(config: ReplayConfig, folder: Path) -> None:
    """Replay the recordings of `config.source` on a simulated cart.

    Writes into `folder` config.yaml, provenance.json, replay.json (parameters and errors) and
    figures/replay.png, and prints a table of the errors. Raises RecordingError for missing or damaged
    recordings, ConfigError for unknown parameters, several poles, or a folder that already holds a run.
    """
    paths = recordings(config.source)
    loaded = [read_recording(path) for path in paths]
    episodes = [each.episode for each in loaded]
    agent, note = recorded_cart(paths), ""
    settings = agent or load_settings(TrainConfig)
    if agent is None and config.cart is None:
        config, note = with_recorded_cart(config, paths[0].parent.parent, settings.cart)
    given = {name: value for name in GROUPS if (value := getattr(config, name)) is not None}
    settings = settings.model_copy(update=given)
    by_file = {str(path): each for path, each in zip(paths, episodes, strict=True)}
    check_same_encoders(by_file, settings.hardware)
    name, pole = chosen_pole("a replay", config.pole, loaded, settings.pole)
    parameters = {**settings.nominal_with(pole), **(config.parameters or {})}
    check_names(parameters, "parameters")
    check_values(parameters)
    cart = {name: value for name, value in parameters.items() if name not in Pole.model_fields}
    note_other_numbers("replay", cart, [Pole(**{name: parameters[name] for name in Pole.model_fields})])
    period, plant = shared_period(by_file), config.plant
    models = settings.models(plant, config.actuator)
    dynamics = Dynamics.of(parameters, models, period, plant.substeps)
    replays = replay(by_file, dynamics, config.restart)
    errors = errors_at(all_errors(replays), REPORTED_TIMES, period)
    if not errors:
        seconds = lead_periods(LEAD, period) * period + REPORTED_TIMES[0]
        raise RecordingError(
            f"from={config.source}: no recording lasts {seconds:g} s without a lost frame: record longer"
        )
    kept = np.concatenate([away_from_upright(each) for each in replays])
    away = errors_at(all_errors(replays)[:, :, kept], REPORTED_TIMES, period)
    write_config(folder, "replay", {**config.model_dump(mode="json", by_alias=True), "seed": None})
    results = {"pole": name, "control_period_s": period, "parameters": parameters, "errors": errors}
    results["errors_away_from_upright"] = away
    write_json(folder / REPLAY, {"recordings": [str(path) for path in paths], **results})
    count = count_text(len(episodes))
    subtitle = f"above: {paths[0].name},  below: {count},  pole={name}"
    save(replay_figure(replays, period, REPORTED_TIMES, "Measured and simulated", subtitle), folder / FIGURE)
    if note:
        print_message("replay", note)
    print(error_table({"": errors}, f"errors of {count}, pole={name}, over the time since a reset"))
    if away:
        print(error_table({"": away}, "the same away from upright; near it an error grows e times in 0.15 s"))
    needs_cart = settings.hardware != nominal_hardware() and not words_given("cart")
    of_cart = [*["cart=<yours>.yaml"] * needs_cart, *words_given("cart", "pole")]
    following = ["cartpole-model", as_word("from", shown(config.source)), *of_cart]
    print_results(folder, f"{REPLAY} and {FIGURE}", " ".join(following))
    if config.view == "web":
        track = parameters["track_half_length"]
        shown_episodes = [shown_beside(*pair, track) for pair in zip(paths, replays, strict=True)]
        with WebView(f"Replay of {paths[0].parent.parent.name}", pole.length, shown_episodes) as view:
            view.wait()


def with_recorded_cart(
    config: ReplayConfig, run: Path, usual: Mapping[str, float]
) -> tuple[ReplayConfig, str]:
    """Return `config` with the cart of an import or an identification, and a line for an unusual one.

    Raises CheckpointError for a cart of another version.
    """
    cart = recorded_config(run).get("cart")
    if cart is None:
        note = "without the config.yaml of their run the recordings tell no cart: this is cart=ip02"
        return config, f"note: {note}"
    if cart == usual:
        return config, ""
    settings = {**config.model_dump(mode="json", by_alias=True), "cart": cart}
    return recorded_settings(ReplayConfig, settings, f"from={run}"), f"note: cart as in from={run}"


def shown_beside(path: Path, replayed: Replayed, track: float) -> dict[str, Any]:
    """Return what the page of `view=web` shows of a recording; the ghost is the simulated cart."""
    episode, rows = replayed.episode, len(replayed.episode.time)
    ghost = np.full((2, rows), np.nan)
    places = replayed.rows()
    for channel, values in zip(ghost, (replayed.x, replayed.theta), strict=True):
        known = np.isfinite(values) & (places < rows)
        channel[places[known]] = values[known]
    return columns(path.stem, episode, track, ghost)
