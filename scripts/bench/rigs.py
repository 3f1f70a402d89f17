#!/usr/bin/env python
"""Does the whole chain work on each rig of conf/cart? The tables of docs/results/rigs.md.

    scripts/bench/rigs.py --seeds 3 --jobs 2 --json rigs.json

For each rig: preflight and identification on an emulated cart, then for each seed a training, an evaluation
of the last checkpoint on the nominal cart and on the emulated one, its C export driving on the emulated
board, a fine-tuning, and a training on the identification with an evaluation on the emulated cart. That cart
differs from the rig's file as the default one from ip02. A fraction is a score over the best one that
reference.py finds with the same settings: on the rig's nominal cart from any of its starts, and on a
simulated cart with the numbers of the emulated one. The runs are in runs/bench/rigs; what exists is not made
again.
"""

from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from common import (
    LOST_SCORE,
    RUNS,
    add_seed_options,
    chosen_seeds,
    failure,
    in_parallel,
    mean_score,
    option_parser,
    positive_int,
    print_table,
    read_json,
    run_once,
    write_json,
)
from reference import ALONE, known_config, known_reference, reference
from truths import simulated

from cartpole_rl.choices import choice, group_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.workflows.config import TrainConfig, load_settings


class Rig(NamedTuple):
    """A cart and what is chosen with it."""

    cart: str
    pole: str
    period: float  # s
    actions: str
    randomization: str

    @property
    def training(self) -> dict[str, Any]:
        """The settings of its training."""
        chosen = self._asdict()
        return {"control_period": chosen.pop("period"), **chosen}

    @property
    def emulated(self) -> tuple[str, ...]:
        """The words for its emulated cart."""
        return "plant=emulated", f"emulator={self.pole}"


RIGS = (
    Rig("ip02", "medium", 0.02, "nine_levels", "wide"),
    Rig("sensorsini", "sensorsini", 0.02, "nine_levels_fine", "dc"),
    Rig("laboratorio", "laboratorio", 0.01, "nine_levels_fine", "dc"),
    Rig("stepper", "rod_03", 0.01, "nine_levels_fine", "stepper"),
)
POLE_FRICTION = "bearing"  # the one that cartpole-identify fits


def words(settings: dict[str, Any]) -> list[str]:
    """Return settings as words of a command."""
    return [f"{name}={value}" for name, value in settings.items()]


def lost(file: Path) -> int:
    """Return the lost episodes in a metrics.json."""
    return sum(each["score"] < LOST_SCORE for each in read_json(file)["episodes"])


def identified(rig: Rig, folder: Path) -> dict[str, Any]:
    """Check and identify the emulated cart of a rig; return the figures."""
    refused = failure("preflight", f"cart={rig.cart}", *rig.emulated)
    given = (f"cart={rig.cart}", f"pole={rig.pole}", f"control_period={rig.period}")
    found = run_once(folder / "identify", "identify", *given, *rig.emulated, result="identification.json")
    report = read_json(found / "identification.json")
    errors = {name: report["quantities"][name]["value"] / true - 1 for name, true in true_ratios(rig).items()}
    return {"preflight": refused or "ready", "errors": errors, "held_out_1_s": report["held_out_1_s"]}


def searched(file: Path) -> int:
    """Return the states of the search in `file`; 0 if there is none."""
    return int(read_json(file)["states"]) if file.exists() else 0


def best_score(rig: Rig, file: Path, states: int) -> float:
    """Return the best score of the search on the nominal cart; one in `file` with as many states will do."""
    if searched(file) < states:
        config = load_settings(TrainConfig, {**rig.training, **ALONE})
        write_json(file, reference(config, states))
    return max(each["score"] for each in read_json(file)["starts"].values())


def emulated_score(rig: Rig, file: Path, states: int) -> float:
    """Return the best score of the search with the numbers of the emulated cart, from 0 m."""
    if searched(file) < states:
        cart = choice(f"cart/{rig.cart}")
        numbers = {**cart, **simulated(emulated_cart(rig), cart)}
        config = known_config(numbers, control_period=rig.period, actions=rig.actions)
        write_json(file, known_reference(config, states))
    return float(read_json(file)["score"])


def emulated_cart(rig: Rig) -> EmulatorSettings:
    """Return the settings of the emulated cart of a rig."""
    pole = EmulatorSettings(**group_choices("emulator").get(rig.pole, {}))
    return pole.of_cart(choice(f"cart/{rig.cart}"))


def true_ratios(rig: Rig) -> dict[str, float]:
    """Return the emulated cart's quantities of which motion shows the ratio to the mass, as identified."""
    truth = emulated_cart(rig)
    mass = truth.cart_mass + truth.backdrivability * truth.pole_mass
    a, b, _ = truth.force_curve
    gain = 1e3 * (b + 400 * a) * (1 + truth.force_asymmetry / 2) / mass
    return {"force_gain": gain, "viscous": truth.cart_viscous / mass}


def driven(rig: Rig, folder: Path, seed: int) -> dict[str, Any]:
    """Train, evaluate, export and fine-tune with one seed; return the figures of the last checkpoint."""
    parent = folder / str(seed)
    run = run_once(parent / "train", "train", *words(rig.training), f"seed={seed}")

    def evaluated(name: str, *more: str) -> Path:
        return run_once(parent / name, "evaluate", f"run={run}", *more) / "metrics.json"

    drawn = evaluated("drawn", f"randomization={rig.randomization}", "episodes=200")
    run_once(parent / "c", "export", f"run={run}", "format=c", result="policy.c")
    onboard = ("emulator.firmware=c", "emulator.policy=onboard")
    tuned = run_once(
        parent / "finetune",
        "finetune",
        f"run={run}",
        *rig.emulated,
        "episodes=10",
        "evaluation_episodes=5",
        result="comparison.json",
    )
    return {
        "nominal": mean_score(run / "metrics.json"),
        "lost": lost(run / "metrics.json"),
        "drawn": mean_score(drawn),
        "drawn_lost": lost(drawn),
        "emulated": mean_score(evaluated("emulated", *rig.emulated, "episodes=5")),
        "onboard": onboard_score(evaluated("onboard", *rig.emulated, *onboard, "episodes=3")),
        "tuned": read_json(tuned / "comparison.json"),
        "identified": mean_score(identified_agent(rig, folder, seed)),
    }


def identified_agent(rig: Rig, folder: Path, seed: int) -> Path:
    """Train on the identification, as `cartpole-identify` says; return the metrics on the emulated cart."""
    found = folder / "identify"
    report = read_json(found / "identification.json")
    files = {group: str(found / f"{group}.yaml") for group in ("cart", "pole", "randomization")}
    frictions = {"cart_friction": report["cart_friction"], "pole_friction": POLE_FRICTION}
    parent = folder / str(seed)
    settings = words({**rig.training, **files, **frictions})
    run = run_once(parent / "identified", "train", *settings, f"seed={seed}")
    name, emulated = parent / "identified_emulated", (*rig.emulated, "episodes=5")
    return run_once(name, "evaluate", f"run={run}", *emulated) / "metrics.json"


def onboard_score(file: Path) -> float:
    """Return the mean score (6.2) of the policy on the board."""
    return float(read_json(file)["onboard"]["score"]["mean"])


def main() -> None:
    """Drive the rigs and print the tables."""
    parser = option_parser(__doc__)
    add_seed_options(parser, 3)
    parser.add_argument("--jobs", type=positive_int, default=1, help="rigs at a time (1)")
    parser.add_argument("--states", type=positive_int, default=1000, help="of the search (1000)")
    options = parser.parse_args()

    searching = Lock()

    def work(rig: Rig) -> dict[str, Any]:
        folder = RUNS / "rigs" / rig.cart
        found: dict[str, Any] = identified(rig, folder)
        with searching:  # torch compiles in one thread at a time
            found["reference"] = best_score(rig, folder / "reference.json", options.states)
            file = folder / "emulated_reference.json"
            found["emulated_reference"] = emulated_score(rig, file, options.states)
        found["seeds"] = {seed: driven(rig, folder, seed) for seed in chosen_seeds(options)}
        return found

    results = dict(zip([rig.cart for rig in RIGS], in_parallel(work, RIGS, options.jobs), strict=True))
    write_json(options.json, results)
    rows = []
    for rig, found in results.items():
        for seed, figures in found["seeds"].items():
            best, emulated = found["reference"], found["emulated_reference"]
            rows.append(
                {
                    "rig": rig,
                    "seed": str(seed),
                    "references": f"{best:.0f}, {emulated:.0f}",
                    **{name: f"{figures[name] / best:.3f}" for name in ("nominal", "drawn")},
                    **{
                        name: f"{figures[name] / emulated:.3f}"
                        for name in ("emulated", "onboard", "identified")
                    },
                }
            )
    print_table(rows)


if __name__ == "__main__":
    main()
