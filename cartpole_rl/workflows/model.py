"""Learn from recordings what the identified physics lacks, and report the errors on held-out recordings.

Every fifth recording is held out: nothing is fitted to it. The resulting model is read by plant=learned.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cartpole_rl.choices import choice, group_choices
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.checks import (
    check_directions,
    check_each,
    check_explained,
    check_same_encoders,
    hardly_explained,
    shared_period,
)
from cartpole_rl.identification.ensemble import SHARE, Ensemble
from cartpole_rl.identification.fit import Fit, best_fit
from cartpole_rl.identification.identify import HORIZON
from cartpole_rl.identification.prediction import CERTAIN, LEAD, REPORTED, errors_at, predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import Windows, cut_windows, held_out_windows, hold_out, lead_periods
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.learned import LearnedModel, save_model
from cartpole_rl.plants.settings import MODEL, LearnedSettings
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.predictions import (
    LEARNED,
    PHYSICS,
    REPORTED_TIMES,
    ensemble_figure,
    error_table,
    spread_table,
)
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import count_text
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_hardware
from cartpole_rl.run_folder import FIGURES, MODELLED, recordings, write_config, write_json
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import as_word, print_results, progress_bar, shown, waiting, words_given
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import ModelConfig
from cartpole_rl.workflows.poles import POLES, chosen_pole

FIGURE = f"{FIGURES}/model.png"
FRICTION_MODELS = (CART_FRICTIONS.find("sigmoid"), CART_FRICTIONS.find("step"))  # candidates for the cart


def learn_model(config: ModelConfig, folder: Path) -> None:
    """Fit the physics to the recordings of `config.source`, and learn its residual.

    Writes into `folder` config.yaml, provenance.json, model.pt (for plant=learned), model.json (parameters
    and errors) and figures/model.png, and prints tables of the errors on held-out recordings. Raises
    RecordingError for missing, damaged, too short or implausible recordings, ConfigError for several poles or
    a folder that already holds a run, LearningError if learning diverges.
    """
    use_threads(config.threads)
    found = (path for source in config.source for path in recordings(source))
    paths = [*{path.resolve(): path for path in found}.values()]  # one that is given twice counts once
    loaded = [read_recording(path) for path in paths]
    episodes = [each.episode for each in loaded]
    by_file = {str(path): each for path, each in zip(paths, episodes, strict=True)}
    check_same_encoders(by_file, config.hardware)
    pole_name, pole = chosen_pole("a model", config.pole, loaded)
    period = shared_period(by_file)
    check_each(by_file, period)
    check_directions(episodes, period)
    training, held_out = hold_out(episodes)
    windows = held_out_windows(held_out, period, max(REPORTED_TIMES))
    with waiting("fitting the physics"):
        fit, models = fit_physics(cut_windows(training, period), config, pole, period)
        dynamics = Dynamics.of(fit.parameters, models, period, LearnedSettings.substeps)
        replays = check_explained(by_file, dynamics, HORIZON)
        doubts = hardly_explained(by_file, replays, dynamics)
    for doubt in doubts:
        print(f"warning: {doubt}")
    ensemble = learn(training, dynamics, fit, config)
    model = learned_model(fit, ensemble, config.hardware)
    physics = predict(windows, ensemble.dynamics)
    learned = predict(windows, ensemble.dynamics, ensemble.best)
    errors = {
        name: errors_at(each.error, REPORTED_TIMES, period, each.spread)
        for name, each in ((PHYSICS, physics), (LEARNED, learned))
    }
    write_config(folder, "model", config.model_dump(mode="json", by_alias=True))
    save_model(folder / MODEL, model)
    data = {"pole": pole_name, "control_period_s": period, "recordings": [str(path) for path in paths]}
    write_json(folder / MODELLED, {**data, **results(model, ensemble, windows, errors)})
    subtitle = f"{count_text(len(episodes))}, pole={pole_name}, {windows.number} held-out windows"
    save(ensemble_figure(physics, learned, ensemble, subtitle), folder / FIGURE)
    print(error_table(errors, f"errors on {windows.number} held-out windows, over the time predicted"))
    print(
        f"\n{spread_table(errors[LEARNED], CERTAIN, 'RMS errors and ensemble spreads on the same windows')}"
    )
    print_results(folder, f"{MODEL}, {MODELLED} and {FIGURE}", next_command(model, pole_name, folder))


def next_command(model: LearnedModel, pole: str, folder: Path) -> str:
    """Return the command that trains on a model of the pole of this name."""
    words = ["cartpole-train plant=learned", as_word("plant.model", shown(folder))]
    if model.hardware.scales_text != nominal_hardware().scales_text:
        scales = {name: hardware_of(cart).scales_text for name, cart in group_choices("cart").items()}
        alike = (name for name, text in scales.items() if text == model.hardware.scales_text)
        words.append(f"cart={next(alike, '<yours>.yaml')}")
    if pole != POLES[0]:  # the default
        words += words_given("pole") or [f"pole={pole}"]
    if not math.isclose(model.period, choice("train")["control_period"]):
        words.append(f"control_period={model.period:g}")
    return " ".join(words)


def learn(episodes: Sequence[Episode], dynamics: Dynamics, fit: Fit, config: ModelConfig) -> Ensemble:
    """Return the ensemble that has learned the residual of the fitted physics."""
    windows = cut_windows(episodes, dynamics.period, most=config.windows)
    lead = lead_periods(LEAD, dynamics.period)
    seconds = lead * dynamics.period + max(REPORTED_TIMES)
    longer = cut_windows(episodes, dynamics.period, seconds, config.windows)._replace(lead=lead)
    ensemble = Ensemble(
        windows, dynamics, fit.spread, config.ensemble, config.seed, config.hardware.track_span
    )
    with progress_bar(config.ensemble.updates, "updates") as progress, waiting("learning"):

        def show_progress(update: int, losses: list[float]) -> None:
            progress.set_postfix_str(f"validation loss {np.mean(losses):.2f}")
            progress.update(update - progress.n)

        ensemble.learn(show_progress)
    with waiting("calibrating"):
        widening = float(ensemble.calibrate(longer).widening)
    if ensemble.allowed is not None and ensemble.allowed < SHARE:
        print(
            f"warning: the members, moved apart {widening:g} times, allow {ensemble.allowed:.1%} of some "
            f"errors, not {SHARE:.0%}: the model is less certain than its spreads say; record more, or "
            "give more updates"
        )
    return ensemble


def fit_physics(windows: Windows, config: ModelConfig, pole: Pole, period: float) -> tuple[Fit, Models]:
    """Return the fit under the best model of the cart's friction, and its physics models."""
    nominal = config.nominal_with(pole)
    plant = LearnedSettings
    candidates = [
        Models(each, config.pole_friction.model, config.actuator, plant.integrator, plant.pole_presses)
        for each in FRICTION_MODELS
    ]
    fit, models = best_fit(windows, nominal, candidates, period, plant.substeps)
    errors = f"{1e3 * fit.spread[0]:.2f} mm (cart) and {np.degrees(fit.spread[1]):.2f} deg (pole)"
    print(
        f"physics with cart_friction={models.cart_friction}: typical error {errors} over "
        f"{windows.number} windows of {windows.periods * period:g} s (1.48 times the median)"
    )
    return fit, models


def learned_model(fit: Fit, ensemble: Ensemble, hardware: Hardware) -> LearnedModel:
    """Return the physics and the residual as the file model.pt holds them."""
    dynamics, residual = ensemble.dynamics, ensemble.best.as_float()
    simulated = dynamics.models, dynamics.period, dynamics.substeps
    return LearnedModel(fit.parameters, *simulated, residual, hardware)


def results(
    model: LearnedModel, ensemble: Ensemble, held_out: Windows, errors: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the part of model.json that follows from learning."""
    return {
        "learned_from_windows": int((~ensemble.left_out).any(0).sum()),
        "held_out_windows": held_out.number,
        "widening": float(model.residual.widening),
        "within_spreads": ensemble.allowed,
        "cart_friction": str(model.models.cart_friction),
        "parameters": model.parameters,
        "errors": errors,
        "network_over_physics": {
            name: errors[LEARNED][-1][f"rms_{name}"] / errors[PHYSICS][-1][f"rms_{name}"] for name in REPORTED
        },
        "left_out_loss": ensemble.history,
    }
