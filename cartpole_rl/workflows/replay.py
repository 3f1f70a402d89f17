"""Drive the simulated cart with recorded motor values, and report its errors against the recording.

The simulated cart is reset to the measured state every `restart` seconds: over a whole episode any two carts
diverge.
"""

from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.recordings import LENGTH, read_recording
from cartpole_rl.identification.prediction import errors_at
from cartpole_rl.identification.replay import all_errors, replay
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import recorded_period
from cartpole_rl.physics.bounds import check_names, check_values
from cartpole_rl.physics.models import Models
from cartpole_rl.randomization.checks import check_one_pole
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.error_tables import REPORTED_TIMES, replay_table
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.figures.replays import replay_figure
from cartpole_rl.reporting.words import count_text
from cartpole_rl.workflows.config import ReplayConfig
from cartpole_rl.workflows.recordings import recordings
from cartpole_rl.workflows.run_folder import write_config, write_json

REPLAY, FIGURE = "replay.json", "figures/replay.png"
POLES = ("medium", "large")
SIMILAR = 0.1  # largest relative difference between a recorded pole's length and that of one of POLES


def replay_recordings(config: ReplayConfig, folder: Path) -> None:
    """Replay the recordings of `config.source` on a simulated cart.

    Writes into `folder` config.yaml, provenance.json, replay.json (parameters and errors) and
    figures/replay.png, and prints a table of the errors. Raises RecordingError for missing or damaged
    recordings, ConfigError for unknown parameters, several poles, or a folder that already holds a run.
    """
    paths = recordings(config.source)
    episodes = [read_recording(path) for path in paths]
    name, pole = replayed_pole(config, paths)
    parameters = simulated_parameters(config, pole)
    period = recorded_period(episodes[0])
    dynamics = Dynamics.of(parameters, physics_models(config), period, config.plant.substeps)
    replays = replay(episodes, dynamics, config.restart)
    errors = errors_at(all_errors(replays), REPORTED_TIMES, period)
    write_config(folder, "replay", {**config.model_dump(mode="json", by_alias=True), "seed": None})
    results = {"pole": name, "control_period_s": period, "parameters": parameters, "errors": errors}
    write_json(folder / REPLAY, {"recordings": [str(path) for path in paths], **results})
    count = count_text(len(episodes))
    subtitle = f"above: {paths[0].name},  below: {count},  pole={name}"
    save(replay_figure(replays, period, REPORTED_TIMES, "Measured and simulated", subtitle), folder / FIGURE)
    print(replay_table(errors, f"errors of {count}, pole={name}, over the time since a reset"))
    print(f"{folder}/{REPLAY} and {FIGURE} are written")


def physics_models(config: ReplayConfig) -> Models:
    """Return the physics models of the simulated cart."""
    return Models(
        config.cart_friction.model,
        config.pole_friction.model,
        config.actuator,
        config.plant.integrator,
        config.plant.pole_presses,
    )


def replayed_pole(config: ReplayConfig, paths: Sequence[Path]) -> tuple[str, Pole]:
    """Return name and parameters of the simulated pole. Raises ConfigError where several are chosen."""
    if config.pole is None:
        return recorded_pole(paths)
    check_one_pole("a replay", config.pole)
    return config.pole.name, config.pole.nominal


def recorded_pole(paths: Sequence[Path]) -> tuple[str, Pole]:
    """Return the one of POLES with the recorded length; the first where no recording states its length.

    Raises ConfigError for several lengths or the length of another pole, RecordingError for a damaged header.
    """
    known = {name: Pole(**choice(f"pole/{name}")["choices"][name]) for name in POLES}
    lengths = sorted({length for path in paths if (length := recorded_length(path))})
    if not lengths:
        return POLES[0], known[POLES[0]]
    if len(lengths) > 1:
        several = ", ".join(f"{length:g}" for length in lengths)
        raise ConfigError(f"pole: poles of {several} m were recorded; replay those of one pole at a time")
    (length,) = lengths
    for name, pole in known.items():
        if abs(length / (2 * pole.pole_com) - 1) < SIMILAR:
            return name, pole
    raise ConfigError(f"pole: one of {length:g} m was recorded; give pole=medium, large or your own")


def recorded_length(path: Path) -> float | None:
    """Return the pole's length (m) in a recording's header; None where it has none. Raises RecordingError."""
    with path.open() as file:
        pairs = (line[1:].partition(":") for line in file if line.startswith("#"))
        text = {key.strip(): value.strip() for key, _, value in pairs}.get(LENGTH)
    try:
        return float(text) if text else None
    except ValueError:
        raise RecordingError(f"{path} is damaged: {LENGTH} is {text!r}, and not a number") from None


def simulated_parameters(config: ReplayConfig, pole: Pole) -> dict[str, float]:
    """Return all parameters of the simulated cart. Raises ConfigError."""
    explicit = config.parameters or {}
    check_names(explicit)
    friction = {**config.cart_friction.parameters, **config.pole_friction.parameters}
    parameters = {**config.cart, **friction, **pole.model_dump(), **explicit}
    check_values(parameters)
    return parameters
