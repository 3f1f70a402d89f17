#!/usr/bin/env python
"""How well is a real Quanser IP02 of another laboratory predicted? A table of docs/results/real.md.

    pip install mat-io pandas
    scripts/bench/real_ip02.py FOLDER --json real_ip02.json

FOLDER is `results` of the repository that docs/results/real.md names. The cart is identified from the first
70 s of the log of June 18th, 14:21, and judged on the rest of that log and on the one of 17:32.
The runs are in runs/bench/real_ip02; what exists is not made again.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import RUNS, option_parser, print_table, read_json, run_once, write_json
from numpy.typing import NDArray
from real import (
    MODEL,
    ONE_STEP,
    OWNERS,
    PHYSICS,
    RESIDUAL,
    away,
    dynamics,
    figures,
    identified,
    recordings,
    stretches,
    table_row,
)

from cartpole_rl.choices import choice, load
from cartpole_rl.files import write_text
from cartpole_rl.identification.prediction import predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.plants.learned import load_model
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.rig.hardware import parameters_of
from cartpole_rl.run_folder import IDENTIFIED

Array = NDArray[np.float64]
FIRST, OTHER = (Path("Testing", f"data_18-06-2020_{time}.mat") for time in ("14-21_44", "17-32_26"))
PERIOD, FITTED = 0.025, 70.0  # s
CART = """\
# Quanser's IP02 behind Quanser's amplifier; a motor value of 250 is 10 V. Numbers by the recordings' owners,
# in functions/getParameters.m of their repository.
defaults: [ip02]
cart_mass: 0.499      # kg: 0.38, and 0.119 of the motor's rotor, eta_g K_g^2 J_m / r_mp^2
cart_viscous: 9.11    # N s/m: 4.3, and 4.81 of the back-EMF, eta_g eta_m K_g^2 k_t k_m / (R_m r_mp^2)
force_linear: 0.0429  # N per motor value: eta_g eta_m K_g k_t / (R_m r_mp) = 1.072 N per volt
force_offset: 0.0     # N
motor_offset: 0
motor_per_newton: 23.3  # 1 / force_linear
"""
LATENCY = 0.025  # s: the motion follows the voltage by about a period
PUBLISHED = {"pole_viscous": 2.4e-3, "pole_com": 0.16825, "pole_inertia": 1.2e-3, "pole_mass": 0.127}
NO_FRICTION = {"cart_coulomb": 0.0, "pole_drag": 0.0}  # theirs is viscous


def log_of(file: Path) -> dict[str, Array]:
    """Return time, state and voltage of a recording of MATLAB: columns [T] by name."""
    from matio import load_from_mat  # no package of the project needs it

    (data,) = load_from_mat(file)["data"].flat
    series = {name: series_of(each) for group in ("Xmsr", "U") for name, each in fields(data[group])}
    time, _ = series["x_c"]
    (of_voltage, voltage), *_ = (each for name, each in series.items() if name in ("u", "signal1"))
    held = np.searchsorted(of_voltage, time + 1e-6) - 1
    return {"time": time, **{name: series[name][1] for name in ("x_c", "alpha")}, "u": voltage[held]}


def fields(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the members of a structure by name."""
    (values,) = group.flat
    yield from zip(values.dtype.names, values, strict=True)


def series_of(series: Any) -> tuple[Array, Array]:
    """Return times [T] s and values [T] of a `timeseries`."""
    info, values = series.properties["TimeInfo"], np.ravel(series.properties["Data_"])
    start, step = (np.ravel(info.properties[name])[0] for name in ("Start_", "Increment_"))
    return start + step * np.arange(len(values)), values


def imported(run: Path, cart: Path, logs: Mapping[str, Mapping[str, Array]]) -> Path:
    """Return the run folder of `cartpole-import` with logs."""
    beside = run.with_name(f"{run.name}-logs")
    beside.mkdir(parents=True, exist_ok=True)
    for name, columns in logs.items():
        rows, heading = np.stack([*columns.values()], 1), ",".join(columns)
        np.savetxt(beside / f"{name}.csv", rows, "%.9g", ",", header=heading, comments="")
    words = (f"from={beside}", "layout=ip02_2020", f"cart={cart}")
    return run_once(run, "import", *words, result="import.json")


def owners(cart: Path) -> Dynamics:
    """Return the cart of the owners' numbers."""
    pole = Pole(**choice("pole/medium")["choices"]["medium"]).model_dump()
    numbers = {**parameters_of(load("cart", cart).values), **pole, **PUBLISHED, **NO_FRICTION}
    return dynamics({**numbers, "latency": LATENCY}, "linear", "exponential", PERIOD)


def main() -> None:
    """Identify, predict and print the table."""
    parser = option_parser(__doc__)
    parser.add_argument("folder", type=Path, help="results/ of the owners' repository")
    options = parser.parse_args()
    torch.set_num_threads(2)
    home = RUNS / "real_ip02"
    first, other = log_of(options.folder / FIRST), log_of(options.folder / OTHER)
    early = first["time"] < FITTED
    parts = [{name: values[rows] for name, values in first.items()} for rows in (early, ~early)]
    cart = home / "ip02_amplifier.yaml"
    home.mkdir(parents=True, exist_ok=True)
    write_text(cart, CART)
    fit = imported(home / "fit", cart, {"14-21": parts[0]})
    report = imported(home / "report", cart, {"14-21": parts[1], "17-32": other})
    words = (f"from={fit}", f"cart={cart}", "pole=medium")
    period = f"control_period={PERIOD}"
    own = run_once(home / "identify", "identify", *words, period, result=IDENTIFIED)
    step = run_once(home / "one_step", "identify", *words, period, "method=one_step", result=IDENTIFIED)
    model = run_once(home / "model", "model", *words, "pole_friction=bearing", result="model.json")
    learned = load_model(model)
    physics = Dynamics.of(learned.parameters, learned.models, learned.period, learned.substeps)
    carts = {
        OWNERS: owners(cart),
        ONE_STEP: identified(step, "step", PERIOD),
        PHYSICS: identified(own, period=PERIOD),
        MODEL: physics,
    }
    recorded = recordings(report)
    results: dict[str, Any] = {}
    for log in ("14-21", "17-32"):
        windows = stretches((each for name, each in recorded.items() if name.startswith(log)), PERIOD)
        found = {name: predict(windows, each) for name, each in carts.items()}
        found[RESIDUAL] = predict(windows, physics, learned.residual.as_type(torch.float64))
        results[log] = {name: figures(windows, each, PERIOD) for name, each in found.items()}
        print(f"\n{log}: {windows.number} seconds, {away(windows).sum()} of them away from upright")
        print_table([table_row(name, each) for name, each in results[log].items()])
    sensors = {run.name: read_json(run / "import.json")["sensors"] for run in (fit, report)}
    identified_cart = read_json(own / IDENTIFIED)["quantities"]
    write_json(options.json, {"models": results, "sensors": sensors, "identified": identified_cart})


if __name__ == "__main__":
    main()
