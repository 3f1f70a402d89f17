"""Find out what a cart is, by experiments on it or from recordings.

Each experiment is on disk before the next begins, and what is found is found from the files.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from tqdm import tqdm

from cartpole_rl.errors import RecordingError
from cartpole_rl.evaluation.recordings import read_recording, write_recording
from cartpole_rl.identification.checks import check_recordings
from cartpole_rl.identification.experiments import EXPERIMENTS, HELD_OUT, conduct
from cartpole_rl.identification.identify import Identification, identify, predicted, prediction_errors
from cartpole_rl.identification.quantities import Quantity, intervals, quantities
from cartpole_rl.identification.unknowns import WEIGHED
from cartpole_rl.physics.actuator import static_force
from cartpole_rl.physics.friction import dry_friction, viscous_coefficient
from cartpole_rl.physics.models import Actuator, CartFriction, Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.emulated import emulated_plant
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.figures import save
from cartpole_rl.reporting.figures.identified import (
    Known,
    Law,
    experiments_figure,
    interval_figure,
    laws_figure,
    spectrum_figure,
)
from cartpole_rl.reporting.page import page
from cartpole_rl.reporting.table import interval_text, number_text, table
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import EmulatedSettings, IdentifyConfig
from cartpole_rl.workflows.person import confirm, tell
from cartpole_rl.workflows.recordings import RECORDINGS, experiments
from cartpole_rl.workflows.run_folder import write_config, write_json

CART, POLE, RANDOMIZATION, POSTERIOR = "cart.yaml", "pole.yaml", "randomization.yaml", "posterior.npz"
PAGE, SUMMARY = "page.html", "identification.json"
FIGURES = {  # file: what it shows
    "laws": "Friction of the cart and force of the motor, with 95 % of what they may be",
    "intervals": "What was found beside what was thought before: 95 % intervals",
    "experiments": "Each experiment, measured and simulated; each second the simulated cart is put onto the "
    "measured one",
    "held_out": "The experiment that nothing was fitted to",
    "spectrum": "What the recordings tell together: how much of the earlier uncertainty is left in each "
    "combination of numbers",
}
OPEN = {  # what no experiment tells, varied about the cart that was found
    "track_half_length": {"distribution": "uniform", "relative": [-0.1, 0.0]},
    "latency_jitter": {"distribution": "uniform", "absolute": [0.0, 0.002]},
}
BAND = 500  # carts of which a band is made


def identify_cart(config: IdentifyConfig, folder: Path) -> None:
    """Drive or read, check, fit, write. Raises CartPoleError."""
    use_threads(config.threads)
    nominal = config.nominal
    recordings = {} if config.source is None else read(config.source)
    write_config(folder, "identify", config.model_dump(mode="json", by_alias=True))
    if config.source is None:
        record(config, folder / RECORDINGS)
        recordings = read(folder)
    fitted = {name: episode for name, episode in recordings.items() if name != HELD_OUT}
    held_out = recordings.get(HELD_OUT)
    if held_out is None:  # recordings of another kind: the last one judges the fit
        if len(fitted) < 2:
            raise RecordingError(
                f"from={config.source}: give two recordings or more; the last one is held out"
            )
        held_out = fitted.pop(list(fitted)[-1])
    check_recordings([*fitted.values()], config.control_period)
    tell("identify", f"fitting {sum(each.steps for each in fitted.values()) * config.control_period:.0f} s")
    models = Models(CartFriction.STEP, config.pole_friction.model, Actuator.FORCE_CURVE)
    found = identify(
        [*fitted.values()],
        [held_out],
        nominal,
        models,
        config.control_period,
        config.substeps,
        config.windows,
    )
    carts = found.fit.draw(config.carts, np.random.default_rng(config.seed))
    write_found(config, found, carts, folder)
    draw_found(config, found, carts, fitted, folder)
    rows = intervals(found.fit, carts)
    print(found_table(rows))
    print_verdict(found, folder)


def record(config: IdentifyConfig, folder: Path) -> None:
    """Make every experiment on the cart, and write each down as it ends."""
    with closing(the_plant(config)) as plant, tqdm(total=len(EXPERIMENTS), unit=" experiments") as progress:
        progress.set_postfix_str(EXPERIMENTS[0].name)
        for number, (experiment, episode) in enumerate(conduct(plant, config.control_period, config.seed)):
            facts = {"experiment": experiment.name, "control_period_s": config.control_period}
            write_recording(folder / f"{number:02d}_{experiment.name}.csv", episode, facts)
            following = EXPERIMENTS[number + 1 : number + 2]
            progress.set_postfix_str(following[0].name if following else "")
            progress.update()


def the_plant(config: IdentifyConfig) -> SerialPlant:
    """The cart to be identified."""
    if isinstance(config.plant, EmulatedSettings):
        truth = config.emulator.model_copy(update={"start": "hanging"})
        return emulated_plant(truth, config.control_period, tqdm.write, config.plant.rehome)
    return SerialPlant(config.plant, control_period=config.control_period, prompt=tqdm.write, confirm=confirm)


def read(source: Path) -> dict[str, Episode]:
    """Recordings by the names of their experiments, or of their files. Raises RecordingError, ConfigError."""
    return {name: read_recording(path) for name, path in experiments(source).items()}


def write_found(config: IdentifyConfig, found: Identification, carts: np.ndarray, folder: Path) -> None:
    """The cart, its pole, carts to train on, and all figures, as files."""
    parameters, names = found.fit.parameters, CartParameters.names()
    deviation = dict(zip(names, carts.std(1), strict=True))
    told = [*{unknown.name for unknown in found.fit.unknowns} - {*WEIGHED}, *Pole.model_fields]
    law = found.models.cart_friction
    heading = (
        f"# Identified by cartpole-identify; behind each number its standard error. Found with "
        f"cart_friction={law}\n# and pole_friction={found.models.pole_friction}; masses and forces are to "
        f"the scale of the pole's mass, {parameters['pole_mass']:g} kg.\n"
    )
    cart = [name for name in names if name not in Pole.model_fields]
    lines = [f"{name}: {parameters[name]:.6g}  # {in_words(name, deviation[name], told)}" for name in cart]
    (folder / CART).write_text(heading + "\n".join(lines) + "\n")
    pole = Pole(**{name: parameters[name] for name in Pole.model_fields})
    (folder / POLE).write_text(
        yaml.safe_dump({"choices": {"identified": pole.model_dump()}}, sort_keys=False)
    )
    np.savez(
        folder / POSTERIOR,
        names=np.array(names),
        carts=carts,
        told=np.array(told),
        unknowns=np.array([unknown.name for unknown in found.fit.unknowns]),
        point=found.fit.point,
        covariance=found.fit.covariance,
    )
    drawn = {"posterior": "${here}/" + POSTERIOR, "widen": 2.0, "prior_share": 0.0, "ranges": OPEN}
    (folder / RANDOMIZATION).write_text(
        "# Carts as identified, correlations included; their uncertainty doubled.\n"
        + yaml.safe_dump(drawn, sort_keys=False)
    )
    x_error, theta_error = prediction_errors(found.held_out)
    write_json(
        folder / SUMMARY,
        {
            "cart_friction": law,
            "parameters": parameters,
            "standard_errors": {name: float(deviation[name]) for name in told if name in deviation},
            "quantities": {
                each.name: {"value": each.value, "low": each.low, "high": each.high, "unit": each.unit}
                for each in intervals(found.fit, carts)
            },
            "tried": {each.law: {"x_m": each.x_error, "theta_rad": each.theta_error} for each in found.tried},
            "held_out_1_s": {"x_m": x_error, "theta_rad": theta_error},
            "residual_counts": found.fit.rms.tolist(),
            "doubts": found.doubts,
        },
    )


def in_words(name: str, deviation: float, told: Sequence[str]) -> str:
    """What stands behind a number of cart.yaml."""
    unit = unit_of(name)
    if name not in told:
        return f"{unit}, as it was thought"
    return f"{unit}, +- {deviation:.2g}"


def unit_of(name: str) -> str:
    """The unit of a parameter of the cart."""
    return {
        "cart_mass": "kg",
        "track_half_length": "m",
        "track_tilt": "rad",
        "cart_viscous": "N s/m",
        "cart_coulomb": "N",
        "stribeck_velocity": "m/s",
        "sigmoid_slope": "s/m",
        "pole_viscous": "N m s/rad",
        "pole_drag": "N m s^2/rad^2",
        "pole_coulomb": "N m",
        "force_quadratic": "N",
        "force_linear": "N",
        "force_offset": "N",
        "motor_time_constant": "s",
        "latency": "s",
        "latency_jitter": "s",
        "angle_offset": "rad",
        "position_noise": "m",
        "angle_noise": "rad",
    }.get(name, "1")


def draw_found(
    config: IdentifyConfig,
    found: Identification,
    carts: np.ndarray,
    fitted: Mapping[str, Episode],
    folder: Path,
) -> None:
    """Figures, and the page that shows them."""
    period, substeps = config.control_period, config.substeps
    replays = {
        name: predicted([episode], found.fit, found.models, period, substeps)[0]
        for name, episode in fitted.items()
    }
    held_out = {HELD_OUT: found.held_out[0]}
    rows, before = intervals(found.fit, carts), config_quantities(config)
    drawn = {
        "laws": laws_figure(
            friction_law(config.nominal, found, carts), force_law(config.nominal, found, carts)
        ),
        "intervals": interval_figure(
            [Known(each.words, each.unit, *each.interval, before[each.name].value) for each in rows]
        ),
        "experiments": experiments_figure(replays),
        "held_out": experiments_figure(held_out),
        "spectrum": spectrum_figure(found.fit.covariance, [unknown.name for unknown in found.fit.unknowns]),
    }
    for name, figure in drawn.items():
        save(figure, folder / "figures" / f"{name}.png")
    (folder / PAGE).write_text(as_page(config, found, rows, fitted, folder))


def friction_law(nominal: Mapping[str, float], found: Identification, carts: np.ndarray) -> Law:
    """Friction of the cart over its speed: figure 5.2 and 5.3 of the thesis."""
    speed, law = torch.linspace(-0.6, 0.6, 241, dtype=torch.float64), found.models.cart_friction

    def friction(table: torch.Tensor) -> np.ndarray:
        cart = CartParameters.from_table(table[:, None])
        moving = speed[:, None]
        return (dry_friction(moving, cart, law) + viscous_coefficient(cart, law) * moving).numpy()

    return law_over(speed, friction, nominal, found, carts)


def force_law(nominal: Mapping[str, float], found: Identification, carts: np.ndarray) -> Law:
    """Force over motor value: figure 5.5 of the thesis."""
    motor = torch.arange(-255.0, 256.0, dtype=torch.float64)

    def force(table: torch.Tensor) -> np.ndarray:
        cart = CartParameters.from_table(table[:, None])
        return static_force(motor[:, None], cart, found.models.actuator).numpy()

    return law_over(motor, force, nominal, found, carts)


def law_over(
    over: torch.Tensor,
    curve: Callable[[torch.Tensor], np.ndarray],
    nominal: Mapping[str, float],
    found: Identification,
    carts: np.ndarray,
) -> Law:
    """A curve [S, N] of carts [P, N], for the cart found, those drawn from it, and the one before."""

    def one(cart: Mapping[str, float]) -> np.ndarray:
        return curve(torch.tensor([[cart[name]] for name in CartParameters.names()], dtype=torch.float64))[
            :, 0
        ]

    drawn = curve(torch.from_numpy(carts[:, :BAND]))
    return Law(over.numpy(), one(found.fit.parameters), drawn, one(nominal))


def config_quantities(config: IdentifyConfig) -> dict[str, Quantity]:
    """What was thought before, by name."""
    return {each.name: each for each in quantities(config.nominal)}


def as_page(
    config: IdentifyConfig,
    found: Identification,
    rows: Sequence[Quantity],
    fitted: Mapping[str, Episode],
    folder: Path,
) -> str:
    """The page that a person reads."""
    shows = {experiment.name: experiment.shows for experiment in EXPERIMENTS}
    measured = [
        {
            "recording": name,
            "seconds": f"{episode.steps * config.control_period:.0f}",
            "what it shows": shows.get(name, ""),
            "ended by": episode.ended_by,
        }
        for name, episode in fitted.items()
    ]
    before = config_quantities(config)
    values = [
        {
            "what": each.words,
            "found, 95 %": f"{interval_text(*each.interval)} {each.unit}",
            "thought before": f"{number_text(before[each.name].value)} {each.unit}",
        }
        for each in rows
    ]
    laws = [
        {
            "cart_friction": str(each.law),
            "x, mm": f"{1e3 * each.x_error:.2f}",
            "theta, deg": f"{math.degrees(each.theta_error):.2f}",
        }
        for each in found.tried
    ]
    x_error, theta_error = prediction_errors(found.held_out)
    sections: list[tuple[str, Any]] = [
        ("What was measured", measured),
        ("What was found", values),
        ("Laws of the cart's friction", laws),
        (
            "",
            "RMS of a prediction over one second of motion that nothing was fitted to, away from upright: "
            f"{1e3 * x_error:.2f} mm and {math.degrees(theta_error):.2f} degrees.",
        ),
        ("What to doubt", found.doubts or ["Nothing stood out."]),
        ("What to do next", [f"<code>{next_command(found, folder)}</code>"]),
        *[(words, Path("figures") / f"{name}.png") for name, words in FIGURES.items()],
    ]
    return page("A cart, identified", sections)


def next_command(found: Identification, folder: Path) -> str:
    """The training on carts as they were found."""
    return (
        f"cartpole-train cart={folder}/{CART} pole={folder}/{POLE} randomization={folder}/{RANDOMIZATION} "
        f"cart_friction={found.models.cart_friction} pole_friction={found.models.pole_friction}"
    )


def found_table(rows: Sequence[Quantity]) -> str:
    """What was found, for a terminal."""
    shown = [
        {"words": each.words, "value": interval_text(*each.interval), "unit": each.unit} for each in rows
    ]
    return table(shown, {"words": "what", "value": "found, 95 %", "unit": "unit"})


def print_verdict(found: Identification, folder: Path) -> None:
    """How far to believe it, and what to do with it."""
    x_error, theta_error = prediction_errors(found.held_out)
    print(
        f"one second of held-out motion is predicted within {1e3 * x_error:.2f} mm and "
        f"{math.degrees(theta_error):.2f} deg RMS, with cart_friction={found.models.cart_friction}"
    )
    for doubt in found.doubts:
        print(f"doubt: {doubt}")
    print(f"{folder}/{PAGE}, {CART}, {POLE}, {RANDOMIZATION} and figures/ are written; next:")
    print(next_command(found, folder))
