#!/usr/bin/env python
"""How accurate is identification? The tables of docs/results/identification.md.

    scripts/bench/identification.py --truths 20 --json identification.json

Draws emulated carts about the nominal one, runs `cartpole-identify` on each, and compares what it found
with the truth. The runs are in runs/bench/identify/<number>; one that exists is not made again.
"""

import math
from typing import Any

import numpy as np
from common import RUNS, option_parser, print_table, read_json, refusal, write_json
from truths import identification_truths, overrides, simulated_cart

from cartpole_rl.identification.identify import quantities
from cartpole_rl.run_folder import IDENTIFIED

TARGETS = {  # quantity: target of the median error, and whether errors are relative to the truth
    "pole_frequency": (0.01, True),
    "force_gain": (0.03, True),
    "viscous": (0.10, True),
    "coulomb": (0.10, True),
    "pole_damping": (0.10, True),
    "latency": (3.0, False),  # ms
    "deadband": (0.15, True),
}
COVERAGE = 0.85  # target: share of the true values that lie in their intervals


def true_quantities(truth: dict[str, object]) -> dict[str, float]:
    """Return the true values of the quantities that identification reports."""
    return {each.name: each.value for each in quantities(simulated_cart(truth))}


def identify(number: int, truth: dict[str, object]) -> dict[str, Any] | None:
    """Return the identification.json of one cart; None if `cartpole-identify` refused."""
    folder = RUNS / "identify" / f"{number:02d}"
    words = ["plant=emulated", *overrides(truth), f"emulator.seed={number}"]
    if error := refusal(folder, "identify", *words, result=IDENTIFIED):
        print(f"cart {number}: {error}", flush=True)
        return None
    return read_json(folder / IDENTIFIED)


def compare(found: dict[str, Any], true: dict[str, float]) -> dict[str, tuple[float, bool]]:
    """Return each quantity's error, and whether its true value lies in its interval."""
    compared = {}
    for name, (_, relative) in TARGETS.items():
        reported = found["quantities"][name]
        error = abs(reported["value"] - true[name]) / (abs(true[name]) if relative else 1)
        compared[name] = (error, reported["low"] <= true[name] <= reported["high"])
    return compared


def quantity_row(name: str, compared: list[dict[str, tuple[float, bool]]]) -> dict[str, str]:
    """Return the table row of one quantity."""
    target, relative = TARGETS[name]
    scale, unit = (100, "%") if relative else (1, "ms")
    errors, inside = zip(*(each[name] for each in compared), strict=True)
    return {
        "quantity": name,
        "median error": f"{np.median(errors) * scale:.2f} {unit}",
        "worst": f"{np.max(errors) * scale:.2f}",
        "target": f"{target * scale:g}",
        "in its interval": f"{100 * np.mean(inside):.0f} %",
    }


def print_summary(results: list[dict[str, Any]], refused: int) -> None:
    """Print the table, the coverage of the intervals and the held-out errors."""
    compared = [compare(result["found"], result["true"]) for result in results]
    print_table([quantity_row(name, compared) for name in TARGETS])
    covered = np.mean([inside for each in compared for _, inside in each.values()])
    print(
        f"true values in their intervals: {100 * covered:.0f} % (target {100 * COVERAGE:.0f} %); "
        f"carts refused: {refused}"
    )
    held_out = [result["found"]["held_out_1_s"] for result in results]
    errors = [(1e3 * each["x_m"], math.degrees(each["theta_rad"])) for each in held_out]
    for label, (x, theta) in {"median": np.median(errors, axis=0), "worst": np.max(errors, axis=0)}.items():
        print(f"held-out prediction over 1 s, {label} cart: {x:.2f} mm, {theta:.2f} degrees")


def main() -> None:
    """Identify every cart, print a summary and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--truths", type=int, default=20, help="number of carts (20)")
    options = parser.parse_args()
    results, refused = [], 0
    for number, truth in enumerate(identification_truths(options.truths)):
        found = identify(number, truth)
        if found is None:
            refused += 1
            continue
        true = true_quantities(truth)
        results.append({"truth": truth, "true": true, "found": found})
        errors = {name: round(error, 4) for name, (error, _) in compare(found, true).items()}
        print(f"cart {number}: errors {errors}", flush=True)
    if results:
        print_summary(results, refused)
    write_json(options.json, results)


if __name__ == "__main__":
    main()
