"""Drive the simulated cart with recorded motor values, and see how far it strays.

The simulated cart is put where the recorded one was every second: over a whole episode any two carts part.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError, RecordingError
from cartpole_rl.evaluation.recordings import LENGTH, read_recording
from cartpole_rl.identification.replay import Array, Replayed, recorded_period, replay
from cartpole_rl.physics.bounds import check_names, check_values
from cartpole_rl.physics.models import Models
from cartpole_rl.randomization.checks import check_one_pole
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.figures.replays import replay_figure, root_mean_square
from cartpole_rl.reporting.table import number_text, table
from cartpole_rl.workflows.config import ReplayConfig
from cartpole_rl.workflows.evaluate import count_text
from cartpole_rl.workflows.recordings import recordings
from cartpole_rl.workflows.run_folder import write_config, write_json

REPLAY, FIGURE = "replay.json", "figures/replay.png"
MARKED = (0.1, 0.5, 1.0)  # s after a restart, at which errors are told
POLES = ("medium", "large")
SIMILAR = 0.1  # share by which a recorded pole's length may differ from one of POLES


def replay_recordings(config: ReplayConfig, folder: Path) -> None:
    """Read, replay, compare, write. Raises CartPoleError."""
    paths = recordings(config.source)
    episodes = [read_recording(path) for path in paths]
    name, pole = replayed_pole(config, paths)
    parameters = simulated_parameters(config, pole)
    period = recorded_period(episodes[0])
    models = Models(
        config.cart_friction.model,
        config.pole_friction.model,
        config.actuator,
        config.plant.integrator,
        config.plant.pole_presses,
    )
    replays = replay(episodes, parameters, models, period, config.plant.substeps, config.restart)
    errors = errors_at(replays, period)
    write_config(folder, "replay", {**config.model_dump(mode="json", by_alias=True), "seed": None})
    written = {"pole": name, "control_period_s": period, "parameters": parameters, "errors": errors}
    write_json(folder / REPLAY, {"recordings": [str(path) for path in paths], **written})
    note = f"above: {paths[0].name},  below: {count_text(len(episodes))},  pole={name}"
    save(drawn(replays, period, note), folder / FIGURE)
    print(error_table(errors, f"{count_text(len(episodes))}, pole={name}"))
    print(f"{folder}/{REPLAY} and {FIGURE} are written")


def replayed_pole(config: ReplayConfig, paths: Sequence[Path]) -> tuple[str, Pole]:
    """The pole of the simulated cart, with its name. Raises ConfigError where that is not one."""
    if config.pole is None:
        return recorded_pole(paths)
    check_one_pole("a replay", config.pole)
    return config.pole.name, config.pole.nominal


def recorded_pole(paths: Sequence[Path]) -> tuple[str, Pole]:
    """The one of POLES that is as long as the recorded one; the medium one where no recording tells."""
    known = {name: Pole(**choice(f"pole/{name}")["choices"][name]) for name in POLES}
    lengths = sorted({length for path in paths if (length := recorded_length(path))})
    if len(lengths) > 1:
        several = ", ".join(f"{length:g}" for length in lengths)
        raise ConfigError(f"pole: poles of {several} m were recorded; replay those of one pole at a time")
    for length in lengths:
        alike = [name for name, pole in known.items() if abs(length / (2 * pole.pole_com) - 1) < SIMILAR]
        if not alike:
            raise ConfigError(f"pole: one of {length:g} m was recorded; give pole=medium, large or your own")
        return alike[0], known[alike[0]]
    return POLES[0], known[POLES[0]]


def recorded_length(path: Path) -> float | None:
    """m, the length of the pole by a recording's heading; None where it tells none. Raises RecordingError."""
    with path.open() as file:
        pairs = (line[1:].partition(":") for line in file if line.startswith("#"))
        told = {key.strip(): value.strip() for key, _, value in pairs}.get(LENGTH)
    try:
        return float(told) if told else None
    except ValueError:
        raise RecordingError(f"{path} is damaged: {LENGTH} is {told!r}, and not a number") from None


def simulated_parameters(config: ReplayConfig, pole: Pole) -> dict[str, float]:
    """All parameters of the simulated cart. Raises ConfigError."""
    given = config.parameters or {}
    check_names(given)
    friction = {**config.cart_friction.parameters, **config.pole_friction.parameters}
    parameters = {**config.cart, **friction, **pole.model_dump(), **given}
    check_values(parameters)
    return parameters


def errors_at(replays: Sequence[Replayed], period: float) -> list[dict[str, Any]]:
    """RMS and median of the errors at each of MARKED that a stretch reaches."""
    x, theta = stacked(replays)
    told = []
    for moment in MARKED:
        index = round(moment / period)
        if index >= x.shape[1] or not np.isfinite(x[:, index]).any():
            continue
        cart, pole = 1e3 * x[:, index : index + 1], np.degrees(theta[:, index : index + 1])
        told.append(
            {
                "after_s": moment,
                "stretches": int(np.isfinite(cart).sum()),
                "rms_x_mm": float(root_mean_square(cart)[0]),
                "median_x_mm": float(np.nanmedian(np.abs(cart))),
                "rms_theta_deg": float(root_mean_square(pole)[0]),
                "median_theta_deg": float(np.nanmedian(np.abs(pole))),
            }
        )
    return told


def stacked(replays: Sequence[Replayed]) -> tuple[Array, Array]:
    """Errors of all stretches, m and rad, [E, T + 1] each."""
    x, theta = ([getattr(each, name) for each in replays] for name in ("x_error", "theta_error"))
    return np.concatenate(x), np.concatenate(theta)


def drawn(replays: Sequence[Replayed], period: float, note: str) -> Figure:
    """The first episode, and the errors of all."""
    first, (x, theta) = replays[0], stacked(replays)
    lag = period * np.arange(x.shape[1], dtype=np.float64)
    title = "Simulated beside recorded"
    return replay_figure(first.episode, first.time, first.x, first.theta, lag, x, theta, MARKED, title, note)


def error_table(errors: Sequence[Mapping[str, Any]], heading: str) -> str:
    """The errors as a person asks for them."""
    columns = {
        "after": f"{heading}: after",
        "rms_x_mm": "cart RMS, mm",
        "median_x_mm": "median, mm",
        "rms_theta_deg": "angle RMS, deg",
        "median_theta_deg": "median, deg",
    }
    rows = [
        {**{key: number_text(each[key]) for key in columns if key in each}, "after": f"{each['after_s']:g} s"}
        for each in errors
    ]
    return table(rows, columns)
