#!/usr/bin/env python
"""How well is a real cart predicted? The tables and figures of docs/results/real.md.

    scripts/bench/real.py FOLDER --json real.json --figures docs/images

FOLDER holds recordings of the cart of the Sensors Group in Zurich, fetched as docs/results/real.md says:
Experiment-0.csv to Experiment-119.csv, of which everything is identified, and Experiment-120.csv to
Experiment-179.csv, on which everything is judged. The folder of --of-2020 holds logs of PD control in 2020.
The runs are in runs/bench/real; what exists is not made again.
"""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import toolbox
import torch
from common import FIRST_SEED, RUNS, option_parser, print_table, read_json, refusal, run_once, write_json
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.choices import choice
from cartpole_rl.drawing import colours
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.identification.prediction import CERTAIN, LEAD, Prediction, is_away, predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.sensors import delayed
from cartpole_rl.identification.windows import Windows, cut_stretches, cut_windows, joined, lead_periods
from cartpole_rl.physics.models import Models
from cartpole_rl.plants.learned import load_model
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting import style
from cartpole_rl.rig.hardware import LARGEST_MOTOR, parameters_of
from cartpole_rl.rig.parameters import completed
from cartpole_rl.run_folder import IDENTIFIED, RECORDINGS
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.identify import split

Array = NDArray[np.float64]
FIT, REPORT = range(120), range(120, 180)  # numbers of the logs
PERIOD, PERIOD_2020, SUBSTEPS = 0.02, 0.005, 12
WINDOWS = 300  # that a cart is fitted to, at most: the default of cartpole-identify
LAYOUT = "layout=sensorsini_2022"
MOTORS_2020 = {  # its logs, and what their layout lacks
    "stock": ("*2020-03-09-14-2*.csv", ("layout.angle.upright=3086",)),
    "Pololu": ("*2020-02-20-15-16-37*.csv", ("layout.angle.upright=3114", "layout.motor.full=7055")),
}
CART = "cart=sensorsini"
RIG = (CART, "pole=sensorsini")
SECONDS = (30, 60, 120)  # of recordings to identify from
SEEDS = range(FIRST_SEED, FIRST_SEED + 3)  # of agents
SETS = 3  # of recordings, for each of SECONDS
TIMES = (0.1, 0.2, 0.5, 1.0)  # s predicted
UNITS = {"mm": 1e3, "deg": 180 / np.pi}  # of m and rad
SLOW, MISSING = 0.01, 4.0  # m/s of the friction's sign; m/s^2 that a dropout of the motor takes away
LATENCY = 0.015  # s, by the owners' logs
PUBLISHED = {"cart_viscous": 4.77, "pole_viscous": 2.5e-4}  # N s/m, N m s/rad: their config.yml of 2022
PUBLISHED_FORCE = 2.62  # N at Q = 1
# their model has no dry friction: Q is the control before their compensation of it
OWN_CONTROL = ("layout.motor.name=Q", "layout.motor.full=1", "layout.motor.positive=right")
OWNERS, ONE_STEP, TOOLBOX = "the owners' numbers", "one-step regression", "mujoco.sysid"
PHYSICS, MODEL, RESIDUAL = "cartpole-identify", "cartpole-model, physics alone", "cartpole-model"
COLOURS = dict(
    zip(
        (OWNERS, ONE_STEP, PHYSICS, RESIDUAL),
        (colours.MUTED, colours.ORANGE, colours.BLUE, colours.VERMILLION),
        strict=True,
    )
)


def imported(logs: Iterable[Path], run: Path, *words: str) -> Path:
    """Return the run folder of `cartpole-import` with some logs."""
    if not run.exists():
        beside = run.with_name(f"{run.name}-logs")
        beside.mkdir(parents=True, exist_ok=True)
        for log in logs:
            shutil.copy(log, beside)
    return run_once(run, "import", f"from={run}-logs", CART, *words, result="import.json")


def recordings(run: Path) -> dict[str, Episode]:
    """Return the recordings of a run by name."""
    return {path.stem: read_recording(path).episode for path in sorted((run / RECORDINGS).iterdir())}


def stretches(recorded: Iterable[Episode], period: float = PERIOD) -> Windows:
    """Return every second of the recordings, with its lead."""
    lead = lead_periods(LEAD, period)
    long_enough = (each for each in recorded if each.steps >= 4 * lead)
    return joined([cut_stretches(each, period, TIMES[-1], lead) for each in long_enough])


def owners() -> Dynamics:
    """Return the cart of the owners' numbers."""
    force = {"force_linear": PUBLISHED_FORCE / LARGEST_MOTOR, "latency": LATENCY}
    return dynamics({**nominal(), **PUBLISHED, **force}, "linear", "exponential")


def nominal() -> dict[str, float]:
    """Return the parameters of cart=sensorsini and its pole."""
    pole = Pole(**choice("pole/sensorsini")["choices"]["sensorsini"])
    return {**parameters_of(choice("cart/sensorsini")), **pole.model_dump()}


def dynamics(
    parameters: dict[str, float], cart_friction: str, pole_friction: str, period: float = PERIOD
) -> Dynamics:
    """Return a cart that moves in the steps of an identification."""
    models = Models.of(cart_friction=cart_friction, pole_friction=pole_friction)
    return Dynamics.of(completed(parameters), models, period, SUBSTEPS, period / SUBSTEPS / 2)


def identified(run: Path, friction: str | None = None, period: float = PERIOD) -> Dynamics:
    """Return the cart of a run of `cartpole-identify`."""
    found = read_json(run / IDENTIFIED)
    return dynamics(found["parameters"], friction or found["cart_friction"], "bearing", period)


def by_toolbox(fit: Path, file: Path) -> Any:
    """Return the cart that MuJoCo's toolbox finds from the windows of an identification; None without it."""
    if not toolbox.INSTALLED:
        return None
    if not file.exists():
        fitted, _ = split(recordings(fit))
        found = toolbox.fitted(cut_windows([*fitted.values()], PERIOD, most=WINDOWS), PERIOD)
        write_json(file, {"parameters": found, "at_bounds": toolbox.at_bounds(found)})
    return toolbox.MujocoCart.of(read_json(file)["parameters"], PERIOD)


def away(windows: Windows) -> NDArray[np.bool_]:
    """Return the complete stretches away from upright."""
    motion = windows.positions[windows.lead :]
    return np.isfinite(motion).all((0, 1)) & is_away(motion[:, 1].T)


def figures(windows: Windows, prediction: Prediction, period: float = PERIOD) -> dict[str, Any]:
    """Return errors in mm and degrees: RMS of a second away from upright, and at TIMES in all stretches."""
    found: dict[str, Any] = {}
    chosen = away(windows)
    for channel, (name, factor) in enumerate(UNITS.items()):
        error = factor * prediction.error[:, channel]
        sizes = np.sqrt((error[:, chosen] ** 2).mean(0))
        found[f"away_{name}"] = [float(np.percentile(sizes, share)) for share in (50, 90)]
        for label, kept in (("all", np.full(len(chosen), True)), ("away", chosen)):
            found[f"{label}_at_{name}"] = at_times(error[:, kept], period)
        if prediction.spread.any():
            within = np.abs(error) <= CERTAIN * factor * prediction.spread[:, channel]
            found[f"within_{name}"] = float(within[1:, chosen].mean())
    return found


def at_times(error: Array, period: float) -> list[list[float]]:
    """Return the median and the 90 % of the absolute errors [T + 1, S] at TIMES."""
    at = [np.abs(error[round(time / period)]) for time in TIMES]
    return [[float(np.nanpercentile(each, share)) for share in (50, 90)] for each in at]


def of_2020(logs: Path, home: Path) -> dict[str, Any]:
    """Return for each motor of 2020 what its logs tell of the sensors and of the cart, or why not."""
    found: dict[str, Any] = {}
    for name, (files, layout) in MOTORS_2020.items():
        run = imported(sorted(logs.glob(files)), home / name, "layout=sensorsini_2020", *layout)
        found[name] = {"import": read_json(run / "import.json")}
        words = (f"from={run}", *RIG, f"control_period={PERIOD_2020}")
        own, step = home / f"{name}-identify", home / f"{name}-one_step"
        if error := refusal(own, "identify", *words, result=IDENTIFIED):
            found[name]["refused"] = error
            continue
        run_once(step, "identify", *words, "method=one_step", result=IDENTIFIED)
        found[name] |= held_out_2020(run, own, step)
    return found


def held_out_2020(run: Path, own: Path, step: Path) -> dict[str, Any]:
    """Return what is identified of a motor of 2020, and errors in mm and degrees at TIMES in its last log."""
    _, held_out = split(recordings(run))
    windows = stretches(held_out.values(), PERIOD_2020)
    carts = {
        CART: dynamics(nominal(), "step", "bearing", PERIOD_2020),
        ONE_STEP: identified(step, "step", PERIOD_2020),
        PHYSICS: identified(own, period=PERIOD_2020),
    }
    found = {"stretches": windows.number, "identified": read_json(own / IDENTIFIED)["quantities"]}
    for name, cart in carts.items():
        error = predict(windows, cart).error
        found[name] = {
            unit: at_times(factor * error[:, channel], PERIOD_2020)
            for channel, (unit, factor) in enumerate(UNITS.items())
        }
    return found


def subsets(recorded: Sequence[Path], seconds: float, seed: int) -> list[Path]:
    """Return files, drawn at random, of which about `seconds` s are fitted; every fifth is held out."""
    order = np.random.default_rng(seed).permutation(len(recorded))
    chosen, total = [], 0.0
    for index in order:
        chosen.append(recorded[index])
        total += PERIOD * read_recording(recorded[index]).episode.steps
        if total >= 1.4 * seconds:
            break
    return chosen


def by_seconds(run: Path, windows: Windows, folder: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the errors of carts that are identified from fewer recordings."""
    recorded = sorted((run / RECORDINGS).iterdir())
    found: dict[int, list[dict[str, Any]]] = {}
    for seconds in SECONDS:
        found[seconds] = []
        for seed in range(SETS):
            part = folder / f"{seconds}s_{seed}"
            (part / RECORDINGS).mkdir(parents=True, exist_ok=True)
            for file in subsets(recorded, seconds, seed):
                shutil.copy(file, part / RECORDINGS)
            fit = run_once(part / "identify", "identify", f"from={part}", *RIG, result=IDENTIFIED)
            found[seconds].append(figures(windows, predict(windows, identified(fit))))
    return found


def dropouts(windows: Windows, quantities: dict[str, Any]) -> NDArray[np.bool_]:
    """Return the stretches, [S], in which the motor gives much too little force for three periods."""
    gain, viscous, dry, latency = (
        scale * quantities[name]["value"]
        for name, scale in (("force_gain", 1e-3), ("viscous", 1), ("coulomb", 1), ("latency", 1e-3))
    )
    x = windows.positions[windows.lead - 1 :, 0]
    speed = (x[2:] - x[:-2]) / (2 * PERIOD)
    acceleration = (x[2:] - 2 * x[1:-1] + x[:-2]) / PERIOD**2
    motors = windows.motors[-len(x) + 1 :]
    motor = np.stack([delayed(each, latency / PERIOD)[1:-1] for each in motors.T], 1)
    expected = gain * motor - viscous * speed - dry * np.tanh(speed / SLOW)
    missing = np.sign(motor) * (expected - acceleration)
    running = np.lib.stride_tricks.sliding_window_view(missing, 3, 0).mean(2)
    return np.asarray((running > MISSING).any(0))


def agents(identify: Path, model: Path, folder: Path) -> dict[int, dict[str, Any]]:
    """Return scores and times to upright of agents of the identified cart: last checkpoints."""
    cart = [f"{group}={identify}/{group}.yaml" for group in ("cart", "pole", "randomization")]
    friction = f"cart_friction={read_json(identify / IDENTIFIED)['cart_friction']}"
    found: dict[int, dict[str, Any]] = {}
    for seed in SEEDS:
        run = folder / str(seed)
        words = (*cart, friction, "pole_friction=bearing", "actions=nine_levels_fine", f"seed={seed}")
        train = run_once(run / "train", "train", *words)
        plants = {
            "drawn": (cart[-1], "episodes=200"),
            "learned": ("plant=learned", f"plant.model={model}", "episodes=50"),
            "emulated": ("plant=emulated", "emulator=sensorsini", "emulator.cart=null", "episodes=10"),
        }
        driven = {
            name: run_once(run / name, "evaluate", f"run={train}", *more) for name, more in plants.items()
        }
        found[seed] = {
            name: driving(read_json(each / "metrics.json")["episodes"])
            for name, each in {"nominal": train, **driven}.items()
        }
    return found


def driving(driven: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean score, the number of episodes that never come up, and the others' median time."""
    times = [each["time_to_upright_s"] for each in driven]
    up = [time for time in times if time is not None]
    return {
        "episodes": len(driven),
        "score": float(np.mean([each["score"] for each in driven])),
        "never_up": len(times) - len(up),
        "time_to_upright_s": float(np.median(up)) if up else None,
    }


def over_time(chosen: NDArray[np.bool_], predictions: dict[str, Prediction]) -> Figure:
    """Draw the median error over the time predicted, away from upright."""
    figure = style.new_figure(height=3.4)
    for axes, channel, factor, text in zip(
        figure.subplots(1, 2), (0, 1), (1e3, 180 / np.pi), ("cart (mm)", "angle (deg)"), strict=True
    ):
        for name, colour in COLOURS.items():
            error = factor * np.abs(predictions[name].error[:, channel, chosen])
            axes.plot(PERIOD * np.arange(len(error)), np.median(error, 1), color=colour, label=name)
        style.dress(axes, "prediction time (s)", f"median error, {text}")
        axes.set_xlim(0, TIMES[-1])
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.1)
        if channel == 0:
            axes.legend(fontsize=style.SMALL_SIZE, frameon=False, loc="lower right")
            style.title(axes, "A real cart, predicted for a second", f"{chosen.sum()} held-out swing-ups")
    return figure


def worst(windows: Windows, predictions: dict[str, Prediction]) -> Figure:
    """Draw the swing-up that the physics predicts worst: motor value, speed and position of the cart."""
    chosen = np.flatnonzero(away(windows))
    size = (predictions[PHYSICS].error[:, 0, chosen] ** 2).mean(0)
    index = int(chosen[size.argmax()])
    lead, time = windows.lead, PERIOD * np.arange(windows.periods - windows.lead + 1)
    measured = windows.positions[lead:, 0, index]
    motor = windows.motors[-len(time) + 1 :, index]
    figure = style.new_figure(height=4.6)
    force, place = figure.subplots(2, 1, sharex=True)
    force.step(time[:-1], motor, where="post", color=colours.INK)
    style.dress(force, "", "motor value")
    style.title(
        force,
        "The held-out swing-up that physics predicts worst",
        "at 0.34 s the motor loses nearly all of its force for 0.1 s",
    )
    place.plot(time, 1e3 * measured, color=colours.INK, label="measured")
    for name in (PHYSICS, RESIDUAL):
        simulated = predictions[name].simulated[:, 0, index]
        place.plot(time, 1e3 * simulated, color=COLOURS[name], label=name)
    style.dress(place, "prediction time (s)", "position (mm)")
    place.legend(fontsize=style.SMALL_SIZE, frameon=False)
    return figure


def main() -> None:
    """Identify, predict and print the tables."""
    parser = option_parser(__doc__)
    parser.add_argument("folder", type=Path, help="with Experiment-0.csv to Experiment-179.csv")
    parser.add_argument("--of-2020", type=Path, metavar="FOLDER", help="with the logs of PD control in 2020")
    parser.add_argument("--figures", type=Path, help="folder for the figures")
    options = parser.parse_args()
    torch.set_num_threads(2)
    home = RUNS / "real"
    first, rest = ([options.folder / f"Experiment-{each}.csv" for each in part] for part in (FIT, REPORT))
    fit = imported(first, home / "fit", LAYOUT)
    report = imported(rest, home / "report", LAYOUT)
    blind = imported(first, home / "fit_4096", LAYOUT, "layout.angle.unit=4096")
    own = run_once(home / "identify", "identify", f"from={fit}", *RIG, result=IDENTIFIED)
    step = run_once(home / "one_step", "identify", f"from={fit}", *RIG, "method=one_step", result=IDENTIFIED)
    model = run_once(
        home / "model", "model", f"from={fit}", *RIG, "pole_friction=bearing", result="model.json"
    )
    windows = stretches(recordings(report).values())
    learned = load_model(model)
    controls = imported(rest, home / "report_q", LAYOUT, *OWN_CONTROL)
    predictions = {OWNERS: predict(stretches(recordings(controls).values()), owners())}
    predictions[ONE_STEP] = predict(windows, identified(step, "step"))
    if (cart := by_toolbox(fit, home / "toolbox.json")) is not None:
        predictions[TOOLBOX] = predict(windows, cart)
    predictions[PHYSICS] = predict(windows, identified(own))
    fitted = stretches(recordings(fit).values())
    to_fitted = {PHYSICS: figures(fitted, predict(fitted, identified(own)))}
    if cart is not None:
        to_fitted[TOOLBOX] = figures(fitted, predict(fitted, cart))
    physics = Dynamics.of(learned.parameters, learned.models, learned.period, learned.substeps)
    predictions[MODEL] = predict(windows, physics)
    predictions[RESIDUAL] = predict(windows, physics, learned.residual.as_type(torch.float64))
    results = {name: figures(windows, each) for name, each in predictions.items()}
    sensors = {
        name: read_json(run / "import.json")["sensors"] for name, run in (("4271", fit), ("4096", blind))
    }
    quantities = read_json(own / IDENTIFIED)["quantities"]
    write_json(
        options.json,
        {
            "stretches": {"all": windows.number, "away": int(away(windows).sum())},
            "models": results,
            "fitted": {"away": int(away(fitted).sum()), **to_fitted},
            "by_seconds": by_seconds(fit, windows, home),
            "sensors": sensors,
            "identified": quantities,
            "agents": agents(own, model, home / "agent"),
            "dropouts": after_dropouts(windows, predictions, quantities),
            "widening": float(learned.residual.widening),
            "toolbox": cart and read_json(home / "toolbox.json"),
            "2020": of_2020(options.of_2020, home / "2020") if options.of_2020 else None,
        },
    )
    if options.figures:
        style.save(over_time(away(windows), predictions), options.figures / "real_over_time.png")
        style.save(worst(windows, predictions), options.figures / "real_worst.png")
    print_table([table_row(name, each) for name, each in results.items()])


def after_dropouts(
    windows: Windows, predictions: dict[str, Prediction], quantities: dict[str, Any]
) -> dict[str, Any]:
    """Return the errors away from upright in stretches with a dropout of the motor, and in the others."""
    dropped, chosen = dropouts(windows, quantities), away(windows)
    found: dict[str, Any] = {"with": int((dropped & chosen).sum()), "without": int((~dropped & chosen).sum())}
    for name in (PHYSICS, MODEL, RESIDUAL):
        sizes = 1e3 * np.sqrt((predictions[name].error[:, 0] ** 2).mean(0))
        found[name] = {
            label: np.percentile(sizes[kept & chosen], (50, 90)).tolist()
            for label, kept in (("with", dropped), ("without", ~dropped))
        }
    return found


def table_row(name: str, found: dict[str, Any]) -> dict[str, str]:
    """Return a row of the table."""
    row = {"model": name}
    for unit in ("mm", "deg"):
        row[f"RMS {unit}, median"], row[f"90 % {unit}"] = (f"{each:.2f}" for each in found[f"away_{unit}"])
        row[f"1 s {unit}, all"] = f"{found[f'all_at_{unit}'][-1][0]:.2f}"
    return row


if __name__ == "__main__":
    main()
