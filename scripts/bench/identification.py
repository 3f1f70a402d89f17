#!/usr/bin/env python
"""Identification judged by truths: the tables of docs/identification.md.

    scripts/bench/identification.py --truths 20 --json identification.json

The numbers of each emulated cart are drawn at random about the nominal cart's; `cartpole-identify` drives it,
and what it found is held against what was drawn. Runs go to runs/bench/identify/<number> and are not made
again when they are there.
"""

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.identification.quantities import quantities
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.reporting.table import table

SEED = 2026
WANTED = {  # quantity: largest median error, and whether it is a share (of the truth) or an amount
    "pole_frequency": (0.01, True),
    "force_gain": (0.03, True),
    "viscous": (0.10, True),
    "coulomb": (0.10, True),
    "pole_damping": (0.10, True),
    "latency": (3.0, False),  # ms
    "deadband": (0.15, True),
}
WITHIN = 0.85  # of the truths lie in their intervals


def draw_truth(random: np.random.Generator) -> dict[str, object]:
    """`emulator.*` of one cart."""

    def factor(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    usual = EmulatorSettings()
    friction, side, damping, gain = factor(0.3, 3), between(-0.15, 0.15), factor(0.1, 3), between(0.75, 1.25)
    pole = between(0.8, 1.2)
    return {
        "cart_mass": 0.703 * between(0.8, 1.2),
        "pole_mass": 0.127 * pole,
        "pole_com": 0.1778,
        "pole_inertia": 1.199e-3 * pole,
        "cart_viscous": 0.5 * factor(0.3, 3),
        "cart_coulomb_left": 0.5 * friction * (1 - side),
        "cart_coulomb_right": 0.5 * friction * (1 + side),
        "cart_stiction_ratio": between(1.0, 1.8),
        "pole_viscous": damping * usual.pole_viscous,
        "pole_coulomb": damping * usual.pole_coulomb,
        "pole_drag": damping * usual.pole_drag,
        "force_curve": [0.0, 0.02 * gain, -1.0 * gain],
        "force_asymmetry": between(-0.1, 0.1),
        "deadband_left": between(0, 60),
        "deadband_right": between(0, 60),
        "motor_time_constant": between(0, 0.03),
        "latency": between(0, 0.03),
        "latency_jitter": 0.001,
        "track_tilt": math.radians(between(-0.5, 0.5)),
        "angle_offset": math.radians(between(-1, 1)),
    }


def overrides(truth: dict[str, object]) -> list[str]:
    """The words that make an emulated cart so."""
    return [f"emulator.{name}={value}" for name, value in truth.items()]


def true_quantities(truth: dict[str, object]) -> dict[str, float]:
    """What should be found."""
    settings = EmulatorSettings(**truth).model_dump()
    left, right = settings["cart_coulomb_left"], settings["cart_coulomb_right"]
    a, b, c = settings["force_curve"]
    cart = {
        **choice("cart/ip02"),
        **{name: settings[name] for name in CartParameters.names() if name in settings},
    }
    cart |= {"force_quadratic": a, "force_linear": b, "force_offset": c}
    cart |= {"cart_coulomb": (left + right) / 2, "cart_coulomb_asymmetry": (right - left) / (right + left)}
    return {each.name: each.value for each in quantities(cart)}


def identified(number: int, truth: dict[str, object]) -> dict[str, object] | None:
    """What `cartpole-identify` found; None where it said that it cannot."""
    folder = Path("runs/bench/identify", f"{number:02d}")
    if not (folder / "identification.json").exists():
        command = [Path(sys.executable).with_name("cartpole-identify"), "plant=emulated", *overrides(truth)]
        done = subprocess.run(
            [*command, f"emulator.seed={number}", f"hydra.run.dir={folder}"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            print(f"{number}: {done.stderr.strip().splitlines()[-1]}", flush=True)
            return None
        (folder / "truth.yaml").write_text(yaml.safe_dump(truth))
    return json.loads((folder / "identification.json").read_text())


def main() -> None:
    """Identify every cart, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=20)
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_args()
    random = np.random.default_rng(SEED)
    errors: dict[str, list[float]] = {name: [] for name in WANTED}
    inside: dict[str, list[bool]] = {name: [] for name in WANTED}
    held_out, refused, everything = [], 0, []
    for number in range(given.truths):
        truth = draw_truth(random)
        found = identified(number, truth)
        if found is None:
            refused += 1
            continue
        true = true_quantities(truth)
        for name, (_, share) in WANTED.items():
            told = found["quantities"][name]
            errors[name].append(abs(told["value"] - true[name]) / (abs(true[name]) if share else 1))
            inside[name].append(told["low"] <= true[name] <= told["high"])
        held_out.append(
            (1e3 * found["held_out_1_s"]["x_m"], math.degrees(found["held_out_1_s"]["theta_rad"]))
        )
        everything.append({"truth": truth, "true": true, "found": found})
        print(number, {name: round(values[-1], 4) for name, values in errors.items()}, flush=True)
    rows = [
        {
            "quantity": name,
            "median error": f"{np.median(errors[name]) * (100 if share else 1):.2f} {'%' if share else 'ms'}",
            "worst": f"{np.max(errors[name]) * (100 if share else 1):.2f}",
            "wanted": f"{wanted * (100 if share else 1):g}",
            "in its interval": f"{100 * np.mean(inside[name]):.0f} %",
        }
        for name, (wanted, share) in WANTED.items()
    ]
    print(table(rows, {key: key for key in rows[0]}))
    share_inside = np.mean([value for values in inside.values() for value in values])
    x, theta = np.median(held_out, axis=0)
    print(f"in their intervals: {100 * share_inside:.0f} % (wanted {100 * WITHIN:.0f} %); refused: {refused}")
    worst = np.max(held_out, axis=0).round(2)
    print(f"held out, 1 s: {x:.2f} mm and {theta:.2f} deg in the median, {worst} in the worst")
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
