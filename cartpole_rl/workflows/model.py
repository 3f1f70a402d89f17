"""Learn from recordings what the identified physics lacks, and say whether that helps.

Every fifth recording is held out: nothing is fitted to it. What is written is for plant=learned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.held_out import CERTAIN, LEAD, Prediction, errors_at, predict_held_out
from cartpole_rl.identification.learned import Dynamics, Ensemble
from cartpole_rl.identification.replay import recorded_period
from cartpole_rl.identification.windows import HISTORY, Windows, cut_windows
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.physics.residual import SPACING, UNITS, Residual
from cartpole_rl.plants.learned_model import LearnedModel, save_model
from cartpole_rl.plants.model_file import MODEL
from cartpole_rl.plants.settings import LearnedSettings
from cartpole_rl.randomization.checks import check_one_pole
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.figures.learned_models import learned_model_figure
from cartpole_rl.reporting.table import number_text, table
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import ModelConfig
from cartpole_rl.workflows.evaluate import count_text
from cartpole_rl.workflows.recordings import recordings
from cartpole_rl.workflows.replay import MARKED, recorded_pole
from cartpole_rl.workflows.run_folder import write_config, write_json

REPORT, FIGURE = "model.json", "figures/model.png"
HELD_OUT = 5  # one of so many recordings is held out
LAWS = (CartFriction.SIGMOID, CartFriction.STEP)  # of the cart's friction, that are tried
PHYSICS, LEARNED = "physics alone", "physics + network"


def learn_model(config: ModelConfig, folder: Path) -> None:
    """Read, fit, learn, judge, write. Raises CartPoleError."""
    use_threads(config.threads)
    paths = [path for source in config.source for path in recordings(source)]
    episodes = [read_recording(path) for path in paths]
    name, pole = modelled_pole(config, paths)
    period = recorded_period(episodes[0])
    learned_from, held_out = split(episodes)
    unseen = held_out_windows(held_out, period)
    fit, models = best_fit(learned_from, config, pole, period)
    dynamics = Dynamics.of(fit.parameters, models, period, LearnedSettings.substeps)
    windows = cut_windows(learned_from, period, most=config.windows)
    ensemble = Ensemble(windows, dynamics, fit.rms, config.ensemble, config.seed)
    residual = learned(ensemble)
    judged = {
        PHYSICS: predict_held_out(unseen, dynamics, None),
        LEARNED: predict_held_out(unseen, dynamics, residual),
    }
    errors = {model: errors_at(prediction, MARKED, period) for model, prediction in judged.items()}
    write_config(folder, "model", config.model_dump(mode="json", by_alias=True))
    model = LearnedModel(fit.parameters, models, period, dynamics.substeps, residual.as_float())
    save_model(folder / MODEL, model)
    told = {
        "pole": name,
        "control_period_s": period,
        "recordings": [str(path) for path in paths],
        "learned_from_windows": windows.number,
        "held_out_windows": unseen.number,
        "cart_friction": str(models.cart_friction),
        "parameters": fit.parameters,
        "errors": errors,
        "left_out_loss": ensemble.history,
    }
    write_json(folder / REPORT, told)
    note = f"{count_text(len(episodes))}, pole={name}, {unseen.number} held-out windows"
    save(drawn(judged, model, ensemble, note), folder / FIGURE)
    print(error_table(errors, f"{unseen.number} held-out windows: after"))
    print(f"\n{spread_table(errors[LEARNED])}")
    print(f"{folder}/{MODEL}, {REPORT} and {FIGURE} are written")


def learned(ensemble: Ensemble) -> Residual:
    """What the ensemble learns, with a progress bar."""
    with tqdm(total=ensemble.settings.updates, unit=" updates") as progress:

        def told(update: int, missed: list[float]) -> None:
            progress.set_postfix_str(f"left-out loss {np.mean(missed):.2f}")
            progress.update(update - progress.n)

        return ensemble.learn(told)


def modelled_pole(config: ModelConfig, paths: Sequence[Path]) -> tuple[str, Pole]:
    """The pole that the fit begins with, with its name. Raises ConfigError where that is not one."""
    if config.pole is None:
        return recorded_pole(paths)
    check_one_pole("a model", config.pole)
    return config.pole.name, config.pole.nominal


def split(episodes: Sequence[Episode]) -> tuple[list[Episode], list[Episode]]:
    """What to learn from, and what to judge by: every fifth episode, or the last fifth of each of a few."""
    if len(episodes) >= HELD_OUT:
        chosen = range(HELD_OUT // 2, len(episodes), HELD_OUT)
        return (
            [episode for number, episode in enumerate(episodes) if number not in chosen],
            [episodes[number] for number in chosen],
        )
    ends = [episode.steps - episode.steps // HELD_OUT for episode in episodes]
    return (
        [part(episode, 0, end) for episode, end in zip(episodes, ends, strict=True)],
        [part(episode, end, episode.steps) for episode, end in zip(episodes, ends, strict=True)],
    )


def part(episode: Episode, first: int, last: int) -> Episode:
    """The periods from `first` to before `last` as an episode of its own."""
    rows = {"time", "x", "x_dot", "theta", "theta_dot", "counts"}
    cut = {name: getattr(episode, name)[first : last + 1] for name in rows}
    steps = {
        name: getattr(episode, name)[first:last] for name in ("motor", "score", "score_upright", "reward")
    }
    return replace(episode, **cut, **steps)


def held_out_windows(episodes: Sequence[Episode], period: float) -> Windows:
    """Windows of a lead and the longest of MARKED, overlapping by half.

    The motor values before each are those of its episode.
    """
    ahead = LEAD + round(max(MARKED) / period)
    later = [part(episode, min((HISTORY + ahead) // 2, episode.steps), episode.steps) for episode in episodes]
    try:
        cut = cut_windows([*episodes, *later], period, HISTORY + ahead, most=1000)
    except RecordingError:
        raise RecordingError(
            f"what is held out has no {(HISTORY + ahead) * period:.2f} s without a lost frame: record longer"
        ) from None
    return cut._replace(positions=cut.positions[HISTORY:], motors=cut.motors[HISTORY:])


def best_fit(
    episodes: Sequence[Episode], config: ModelConfig, pole: Pole, period: float
) -> tuple[Fit, Models]:
    """The identified cart, and the laws under which it is found best."""
    windows = cut_windows(episodes, period)
    nominal = {**config.cart, **config.pole_friction.parameters, **pole.model_dump()}
    fits = []
    for law in LAWS:
        models = Models(
            law,
            config.pole_friction.model,
            config.actuator,
            LearnedSettings.integrator,
            LearnedSettings.pole_presses,
        )
        fit = fit_cart(windows, nominal, models, period, LearnedSettings.substeps)
        fits.append((fit, models))
    fit, models = min(fits, key=lambda each: each[0].cost)
    print(
        f"physics: {models.cart_friction} friction, follows {windows.number} half seconds within "
        f"{fit.rms[0]:.1f} and {fit.rms[1]:.2f} counts of cart and pole"
    )
    return fit, models


def drawn(judged: Mapping[str, Prediction], model: LearnedModel, ensemble: Ensemble, note: str) -> Figure:
    """What was learned, and what it is worth."""
    x = ensemble.positions[:, 0].flatten().numpy() * CART_METRES_PER_COUNT
    places = model.residual.places.numpy()
    middles = SPACING * (np.arange(places.shape[1]) - places.shape[1] // 2)
    seen = np.histogram(x, np.append(middles, middles[-1] + SPACING) - SPACING / 2)[0] > 0
    return learned_model_figure(
        model.period * np.arange(len(judged[PHYSICS].error), dtype=np.float64),
        judged[PHYSICS].error,
        judged[LEARNED].error,
        judged[LEARNED].spread,
        middles,
        np.where(seen, UNITS[0] * places.astype(np.float64), np.nan),
        np.array(ensemble.updates, dtype=np.float64),
        np.array(ensemble.history),
        note=note,
    )


def error_table(errors: Mapping[str, Sequence[Mapping[str, Any]]], heading: str) -> str:
    """Errors of both on the same held-out windows."""
    columns = {
        "after": heading,
        "model": "model",
        "rms_x_mm": "cart RMS, mm",
        "median_x_mm": "median, mm",
        "rms_theta_deg": "angle RMS, deg",
        "median_theta_deg": "median, deg",
    }
    rows = [
        {key: number_text(line[key]) for key in columns if key in line}
        | {"after": f"{line['after_s']:g} s" if model == PHYSICS else "", "model": model}
        for lines in zip(*errors.values(), strict=True)
        for model, line in zip(errors, lines, strict=True)
    ]
    return table(rows, columns)


def spread_table(errors: Sequence[Mapping[str, Any]]) -> str:
    """Whether the ensemble knows how wrong it is."""
    columns = {
        "after": "error against spread: after",
        "x": "cart RMS, mm",
        "within_x": f"within {CERTAIN:g} spreads",
        "theta": "angle RMS, deg",
        "within_theta": f"within {CERTAIN:g} spreads",
    }
    rows = [
        {
            "after": f"{line['after_s']:g} s",
            "x": f"{number_text(line['rms_x_mm'])} / {number_text(line['rms_spread_x_mm'])}",
            "within_x": f"{line['within_x_mm']:.0%}",
            "theta": f"{number_text(line['rms_theta_deg'])} / {number_text(line['rms_spread_theta_deg'])}",
            "within_theta": f"{line['within_theta_deg']:.0%}",
        }
        for line in errors
    ]
    return table(rows, columns)
