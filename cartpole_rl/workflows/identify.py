"""Identify a cart, by experiments on it or from recordings.

Each experiment is on disk before the next one starts, and the cart is identified from the files.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.files import write_text
from cartpole_rl.identification.checks import check_recordings
from cartpole_rl.identification.experiments import EXPERIMENTS, HELD_OUT, conduct
from cartpole_rl.identification.identify import Identification, identify
from cartpole_rl.identification.one_step import one_step_estimates
from cartpole_rl.identification.quantities import intervals
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.serial.plant import SerialPlant, cart_plant
from cartpole_rl.reporting.identification import (
    error_text,
    identification_figures,
    identification_page,
    quantities_table,
)
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import table
from cartpole_rl.run_folder import (
    CART,
    FIGURES,
    IDENTIFIED,
    PAGE,
    POLE,
    RANDOMIZATION,
    RECORDINGS,
    write_config,
    write_json,
)
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import confirm, print_message, progress_bar
from cartpole_rl.workflows.build import precedence, use_threads
from cartpole_rl.workflows.checks import note_other_numbers
from cartpole_rl.workflows.config import IdentifyConfig
from cartpole_rl.workflows.identified_errors import BY_HAND, errors, known_truth
from cartpole_rl.workflows.identified_files import friction_choice, report, write_choices
from cartpole_rl.workflows.recordings import experiments
from cartpole_rl.workflows.results import print_results, shown

HELD_OUT_OF = 5  # one recording in so many is held out

Episodes = dict[str, Episode]  # by the name of the experiment, or of the file


def identify_cart(config: IdentifyConfig, folder: Path) -> None:
    """Identify the cart of `config.plant`, or that of the recordings in `config.source`.

    Writes into `folder` config.yaml, provenance.json, recordings/ of experiments, cart.yaml, pole.yaml,
    randomization.yaml and posterior.npz (to train on), identification.json, page.html and figures/; with
    method=one_step only the first three and identification.json. Prints the identified values. Raises
    RecordingError for missing, too few or implausible recordings, ConfigError for several poles or a folder
    that already holds a run, PlantError and LinkError for a cart that fails.
    """
    use_threads(config.threads)
    nominal = config.nominal  # or ConfigError, before the cart moves
    note_other_numbers("identify", config.nominal_cart, [config.pole.nominal])
    source = config.source or folder
    if config.source is None:
        write_config(folder, "identify", config.model_dump(mode="json", by_alias=True))
        record_experiments(config, folder / RECORDINGS)
    files = experiments(source)
    fitted, held_out = split({name: read_recording(path) for name, path in files.items()}, source)
    by_file, held_out_by_file = (
        {str(files[name]): episode for name, episode in chosen.items()} for chosen in (fitted, held_out)
    )
    check_recordings(by_file, held_out_by_file, config.control_period)
    if config.source is not None:
        write_config(folder, "identify", config.model_dump(mode="json", by_alias=True))
    seconds = sum(each.steps for each in fitted.values()) * config.control_period
    print_message("identify", f"fitting {seconds:.0f} s of recordings")
    models = Models.of(cart_friction="step", pole_friction=config.pole_friction.model)
    truth = known_truth(config)
    period, substeps = config.control_period, config.substeps
    if config.method == "one_step":
        regress([*fitted.values(), *held_out.values()], nominal, models, period, truth, folder)
        return
    laws = config.friction_laws
    found = identify(by_file, held_out_by_file, nominal, models, period, substeps, config.windows, laws)
    carts = found.fit.draw(config.carts, np.random.default_rng(config.seed))
    write_choices(found, carts, folder)
    write_json(folder / IDENTIFIED, report(found, carts) | errors(found.fit.parameters, truth, BY_HAND))
    for name, figure in identification_figures(found, carts, fitted).items():
        save(figure, folder / FIGURES / f"{name}.png")
    identified = intervals(found.fit, carts)
    page = identification_page(found, identified, fitted, next_command(found, folder))
    write_text(folder / PAGE, page)
    print(quantities_table(identified))
    print_verdict(found, folder)


def regress(
    episodes: Sequence[Episode],
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    truth: EmulatorSettings | None,
    folder: Path,
) -> None:
    """Estimate parameters from single transitions; write identification.json and print them."""
    estimates = one_step_estimates(episodes, nominal, models, period)
    found = {**nominal, **{name: each.value for name, each in estimates.items()}}
    standard_errors = {name: each.error for name, each in estimates.items() if math.isfinite(each.error)}
    content = {"method": "one_step", "parameters": found, "standard_errors": standard_errors}
    write_json(folder / IDENTIFIED, content | errors(found, truth, nominal.keys() - estimates.keys()))
    rows = [
        {"parameter": name, "estimate": f"{each.value:.4g} ± {each.error:.1g}", "prior": f"{nominal[name]:g}"}
        for name, each in estimates.items()
    ]
    print(table(rows, ["parameter", "estimate", "prior"]))
    print(f"{folder}/{IDENTIFIED} is written; these values are for comparison, not to train on")


def record_experiments(config: IdentifyConfig, folder: Path) -> None:
    """Run every experiment on the cart, and write each one when it ends."""
    with (
        closing(make_plant(config)) as plant,
        precedence(config.plant, config.emulator),
        progress_bar(len(EXPERIMENTS), "experiments") as progress,
    ):
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


def split(recordings: Episodes, source: Path) -> tuple[Episodes, Episodes]:
    """Return the recordings to fit, and the held-out ones.

    Held out are the experiment of that name, or else every fifth recording, or the last of fewer than five.
    """
    names = list(recordings)
    held_out = [HELD_OUT] if HELD_OUT in recordings else names[HELD_OUT_OF - 1 :: HELD_OUT_OF] or names[-1:]
    fitted = {name: episode for name, episode in recordings.items() if name not in held_out}
    if not fitted:
        raise RecordingError(f"from={source}: give two recordings or more; the last one is held out")
    return fitted, {name: recordings[name] for name in held_out}


def next_command(found: Identification, folder: Path) -> str:
    """Return the command that trains on carts like the identified one."""
    run, models = shown(folder), found.models
    return (
        f"cartpole-train cart={run}/{CART} pole={run}/{POLE} randomization={run}/{RANDOMIZATION} "
        f"{friction_choice(models.cart_friction, run)} {friction_choice(models.pole_friction, run)}"
    )


def print_verdict(found: Identification, folder: Path) -> None:
    """Print the prediction error, the warnings and the next command."""
    print(
        f"RMS prediction error over one second of held-out motion: {error_text(found.error)}, with "
        f"cart_friction={found.models.cart_friction}"
    )
    for warning in found.warnings:
        print(f"warning: {warning}")
    files = f"{PAGE}, {CART}, {POLE}, {RANDOMIZATION} and {FIGURES}/"
    print_results(folder, files, next_command(found, folder))
