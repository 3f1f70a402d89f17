"""Drive the simulated cart with recorded motor values, and report its errors against the recording.

The simulated cart is reset to the measured state every `restart` seconds: over a whole episode any two carts
diverge.
"""

from pathlib import Path

from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.prediction import all_errors, errors_at, replay
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import recorded_period
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.predictions import REPORTED_TIMES, replay_figure, replay_table
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.rig.parameters import check_names, check_values
from cartpole_rl.run_folder import FIGURES, recordings, write_config, write_json
from cartpole_rl.terminal import as_word, print_results, shown
from cartpole_rl.workflows.checks import note_other_numbers
from cartpole_rl.workflows.config import ReplayConfig
from cartpole_rl.workflows.poles import chosen_pole

REPLAY, FIGURE = "replay.json", f"{FIGURES}/replay.png"


def replay_recordings(config: ReplayConfig, folder: Path) -> None:
    """Replay the recordings of `config.source` on a simulated cart.

    Writes into `folder` config.yaml, provenance.json, replay.json (parameters and errors) and
    figures/replay.png, and prints a table of the errors. Raises RecordingError for missing or damaged
    recordings, ConfigError for unknown parameters, several poles, or a folder that already holds a run.
    """
    paths = recordings(config.source)
    episodes = [read_recording(path) for path in paths]
    name, pole = chosen_pole("a replay", config.pole, paths)
    parameters = simulated_parameters(config, pole)
    cart = {name: value for name, value in parameters.items() if name not in Pole.model_fields}
    note_other_numbers("replay", cart, [Pole(**{name: parameters[name] for name in Pole.model_fields})])
    period, plant = recorded_period(episodes[0]), config.plant
    models = config.models_with(config.actuator, plant)
    dynamics = Dynamics.of(parameters, models, period, plant.substeps)
    replays = replay(episodes, dynamics, config.restart)
    errors = errors_at(all_errors(replays), REPORTED_TIMES, period)
    write_config(folder, "replay", {**config.model_dump(mode="json", by_alias=True), "seed": None})
    results = {"pole": name, "control_period_s": period, "parameters": parameters, "errors": errors}
    write_json(folder / REPLAY, {"recordings": [str(path) for path in paths], **results})
    count = count_text(len(episodes))
    subtitle = f"above: {paths[0].name},  below: {count},  pole={name}"
    save(replay_figure(replays, period, REPORTED_TIMES, "Measured and simulated", subtitle), folder / FIGURE)
    print(replay_table(errors, f"errors of {count}, pole={name}, over the time since a reset"))
    print_results(folder, f"{REPLAY} and {FIGURE}", f"cartpole-model {as_word('from', shown(config.source))}")


def simulated_parameters(config: ReplayConfig, pole: Pole) -> dict[str, float]:
    """Return all parameters of the simulated cart. Raises ConfigError."""
    explicit = config.parameters or {}
    check_names(explicit, "parameters")
    parameters = {**config.nominal_with(pole), **explicit}
    check_values(parameters)
    return parameters
