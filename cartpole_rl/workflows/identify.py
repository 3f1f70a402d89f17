"""Identify a cart, by experiments on it or from recordings.

Each experiment is on disk before the next one starts, and the cart is identified from the files.
"""

from contextlib import closing
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.files import write_text
from cartpole_rl.identification.checks import check_recordings
from cartpole_rl.identification.experiments import EXPERIMENTS, HELD_OUT, conduct
from cartpole_rl.identification.identify import Identification, identify, predicted, prediction_errors
from cartpole_rl.identification.quantities import intervals, quantities
from cartpole_rl.physics.models import Actuator, CartFriction, Models
from cartpole_rl.plants.cart_plant import cart_plant
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.reporting.curves import force_curve, friction_curve
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.figures.identified import (
    experiments_figure,
    friction_and_force_figure,
    interval_figure,
    spectrum_figure,
)
from cartpole_rl.reporting.identification import (
    Estimate,
    PredictionError,
    Recording,
    estimates_table,
    identification_page,
)
from cartpole_rl.run_files import CART, FIGURES, POLE, RANDOMIZATION, RECORDINGS
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import IdentifyConfig
from cartpole_rl.workflows.identified_files import summary, write_choices
from cartpole_rl.workflows.person import confirm, print_message
from cartpole_rl.workflows.recordings import experiments
from cartpole_rl.workflows.run_folder import write_config, write_json

PAGE, SUMMARY = "page.html", "identification.json"
Episodes = dict[str, Episode]  # by the name of the experiment, or of the file


def identify_cart(config: IdentifyConfig, folder: Path) -> None:
    """Identify the cart of `config.plant`, or that of the recordings in `config.source`.

    Writes into `folder` config.yaml, provenance.json, recordings/ of experiments, cart.yaml, pole.yaml,
    randomization.yaml and posterior.npz (to train on), identification.json, page.html and figures/. Prints
    the identified values. Raises RecordingError for missing, too few or implausible recordings, ConfigError
    for several poles or a folder that already holds a run, PlantError and LinkError for a cart that fails.
    """
    use_threads(config.threads)
    nominal = config.nominal  # or ConfigError, before the cart moves
    source = config.source or folder
    recordings = {} if config.source is None else read_recordings(source)
    write_config(folder, "identify", config.model_dump(mode="json", by_alias=True))
    if config.source is None:
        record_experiments(config, folder / RECORDINGS)
        recordings = read_recordings(source)
    fitted, held_out = split(recordings, source)
    check_recordings([*fitted.values()], config.control_period)
    seconds = sum(each.steps for each in fitted.values()) * config.control_period
    print_message("identify", f"fitting {seconds:.0f} s of recordings")
    models = Models(CartFriction.STEP, config.pole_friction.model, Actuator.FORCE_CURVE)
    period, substeps = config.control_period, config.substeps
    found = identify([*fitted.values()], [held_out], nominal, models, period, substeps, config.windows)
    carts = found.fit.draw(config.carts, np.random.default_rng(config.seed))
    write_choices(found, carts, folder)
    write_json(folder / SUMMARY, summary(found, carts))
    for name, figure in figures(config, found, carts, fitted).items():
        save(figure, folder / FIGURES / f"{name}.png")
    write_text(folder / PAGE, html_page(config, found, carts, fitted, folder))
    print(estimates_table(estimates(config, found, carts)))
    print_verdict(found, folder)


def record_experiments(config: IdentifyConfig, folder: Path) -> None:
    """Run every experiment on the cart, and write each one when it ends."""
    with closing(make_plant(config)) as plant, tqdm(total=len(EXPERIMENTS), unit=" experiments") as progress:
        progress.set_postfix_str(EXPERIMENTS[0].name)
        for number, (experiment, episode) in enumerate(conduct(plant, config.control_period, config.seed)):
            header = {"experiment": experiment.name, "control_period_s": config.control_period}
            write_recording(folder / f"{number:02d}_{experiment.name}.csv", episode, header)
            following = EXPERIMENTS[number + 1 : number + 2]
            progress.set_postfix_str(following[0].name if following else "")
            progress.update()


def make_plant(config: IdentifyConfig) -> SerialPlant:
    """Connect to the cart that is identified."""
    period = config.control_period
    return cart_plant(config.plant, config.emulator, period, "hanging", tqdm.write, confirm)


def read_recordings(source: Path) -> Episodes:
    """Return the recordings in `source`. Raises RecordingError, ConfigError."""
    return {name: read_recording(path) for name, path in experiments(source).items()}


def split(recordings: Episodes, source: Path) -> tuple[Episodes, Episode]:
    """Return the recordings to fit, and the held-out one: that experiment, or else the last recording."""
    held_out = HELD_OUT if HELD_OUT in recordings else list(recordings)[-1]
    fitted = {name: episode for name, episode in recordings.items() if name != held_out}
    if not fitted or (held_out != HELD_OUT and len(recordings) < 2):
        raise RecordingError(f"from={source}: give two recordings or more; the last one is held out")
    return fitted, recordings[held_out]


def estimates(config: IdentifyConfig, found: Identification, carts: np.ndarray) -> list[Estimate]:
    """Return the identified quantities beside their prior values."""
    prior = {each.name: each.value for each in quantities(config.nominal)}
    return [
        Estimate(each.words, each.unit, *each.interval, prior[each.name])
        for each in intervals(found.fit, carts)
    ]


def figures(
    config: IdentifyConfig, found: Identification, carts: np.ndarray, fitted: Episodes
) -> dict[str, Figure]:
    """Return the figures of `reporting.identification.CAPTIONS`."""
    fit, models, nominal = found.fit, found.models, config.nominal
    period, substeps = config.control_period, config.substeps
    replays = {
        name: predicted([episode], fit, models, period, substeps)[0] for name, episode in fitted.items()
    }
    return {
        "friction_and_force": friction_and_force_figure(
            friction_curve(fit.parameters, carts, nominal, models.cart_friction),
            force_curve(fit.parameters, carts, nominal, models.actuator),
        ),
        "intervals": interval_figure(estimates(config, found, carts)),
        "experiments": experiments_figure(replays),
        "held_out": experiments_figure({HELD_OUT: found.held_out[0]}),
        "spectrum": spectrum_figure(fit.covariance, [unknown.name for unknown in fit.unknowns]),
    }


def html_page(
    config: IdentifyConfig, found: Identification, carts: np.ndarray, fitted: Episodes, folder: Path
) -> str:
    """Return the page that shows all results."""
    purposes = {experiment.name: experiment.shows for experiment in EXPERIMENTS}
    recordings = [
        Recording(name, episode.steps * config.control_period, purposes.get(name, ""), episode.ended_by)
        for name, episode in fitted.items()
    ]
    return identification_page(
        recordings,
        estimates(config, found, carts),
        {each.cart_friction: PredictionError(each.x_error, each.theta_error) for each in found.candidates},
        PredictionError(*prediction_errors(found.held_out)),
        found.warnings,
        next_command(found, folder),
    )


def next_command(found: Identification, folder: Path) -> str:
    """Return the command that trains on carts like the identified one."""
    return (
        f"cartpole-train cart={folder}/{CART} pole={folder}/{POLE} randomization={folder}/{RANDOMIZATION} "
        f"cart_friction={found.models.cart_friction} pole_friction={found.models.pole_friction}"
    )


def print_verdict(found: Identification, folder: Path) -> None:
    """Print the prediction error, the warnings and the next command."""
    error = PredictionError(*prediction_errors(found.held_out))
    print(
        f"RMS prediction error over one second of held-out motion: {error.text}, with "
        f"cart_friction={found.models.cart_friction}"
    )
    for warning in found.warnings:
        print(f"warning: {warning}")
    print(f"{folder}/{PAGE}, {CART}, {POLE}, {RANDOMIZATION} and {FIGURES}/ are written; next:")
    print(next_command(found, folder))
