"""Identify a cart, by experiments on it or from recordings.

Each experiment is on disk before the next one starts, and the cart is identified from the files.
"""

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from tqdm import tqdm

from cartpole_rl.checking import validated
from cartpole_rl.choices import choice, is_shipped
from cartpole_rl.composition import key_of
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.evaluation.recordings import LENGTH, read_recording, write_recording
from cartpole_rl.files import replacing, write_text
from cartpole_rl.identification.checks import (
    SHORTEST_HELD_OUT,
    check_recordings,
    check_same_encoders,
    shared_period,
)
from cartpole_rl.identification.experiments import EXPERIMENTS, HELD_OUT, conduct, experiment_guard
from cartpole_rl.identification.identify import Identification, identify, intervals, no_force_up_to
from cartpole_rl.identification.one_step import one_step_estimates
from cartpole_rl.identification.unknowns import WEIGHED
from cartpole_rl.identification.windows import HELD_OUT_OF
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import REGISTRIES, Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.reporting.identification import (
    error_text,
    identification_figures,
    identification_page,
    quantities_table,
)
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import table
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.run_folder import (
    CART,
    CONFIG,
    FIGURES,
    IDENTIFIED,
    PAGE,
    POLE,
    POSTERIOR,
    PROVENANCE,
    RANDOMIZATION,
    RECORDINGS,
    experiments,
    program_of,
    recorded_config,
    write_config,
    write_json,
)
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.terminal import (
    as_word,
    confirm,
    print_message,
    print_results,
    progress_bar,
    shown,
    waiting,
    words_given,
)
from cartpole_rl.workflows.build import precedence, use_threads
from cartpole_rl.workflows.checks import is_given, note_other_numbers
from cartpole_rl.workflows.config import IdentifyConfig, recorded_settings
from cartpole_rl.workflows.poles import warn_of_another_pole

CLOCK = 1e-3  # share by which a clock and the rounding of `shared_period` may change the period
OF_CART = ("cart", "pole", "control_period")  # settings that belong to recordings
UNIDENTIFIABLE = {  # randomized about the identified cart, since no experiment shows them
    "track_half_length": {"distribution": "uniform", "relative": [-0.1, 0.0]},
    "latency_jitter": {"distribution": "uniform", "absolute": [0.0, 0.002]},
}
WIDEN = 2.0  # factor on the standard deviations, for carts to train on
OF_MATCHING = ("friction_laws", "windows", "substeps", "carts")  # settings that method=one_step does not read
JUDGED = 4096  # carts of the posterior, at least, that give intervals and standard errors
BY_HAND = ("pole_mass", "pole_com")  # `unknowns.WEIGHED` as parameters: measured with scales and a ruler
MOTOR = 200  # motor value of the force that is compared; coefficients of a curve are not comparable
FINE = "actions/nine_levels_fine"  # for carts whose force starts at small motor values
SAME = ("cart_mass", "pole_mass", "pole_com", "cart_viscous", "pole_viscous")  # names on both sides

Episodes = dict[str, Episode]  # by the name of the experiment, or of the file


def identify_cart(config: IdentifyConfig, folder: Path, words: Sequence[str] | None = None) -> None:
    """Identify the cart of `config.plant`, or that of the recordings in `config.source`.

    If `config.source` is a run of this command, its settings of OF_CART hold unless the `words` of a command
    line give others.

    Writes into `folder` config.yaml, provenance.json, recordings/ of experiments, cart.yaml, pole.yaml,
    randomization.yaml and posterior.npz (to train on), identification.json, page.html and figures/; with
    method=one_step only the first three and identification.json. Prints the identified values. Raises
    RecordingError for missing, too few or implausible recordings, ConfigError for several poles or a folder
    that already holds a run, PlantError and LinkError for a cart that fails.
    """
    use_threads(config.threads)
    if words is not None:
        config = as_recorded(config, words)
        unread = [name for name in OF_MATCHING if is_given([name], words)]
        if config.method == "one_step" and unread:
            print_message("identify", f"note: method=one_step does not read {', '.join(unread)}")
    nominal = config.nominal  # or ConfigError, before the cart moves
    note_other_numbers("identify", config.nominal_cart, [config.pole.nominal])
    source = config.source or folder
    if config.source is None:
        experiment_guard(config.control_period, config.hardware)  # or ConfigError
        write_config(folder, "identify", config.model_dump(mode="json", by_alias=True))
        try:
            record_experiments(config, folder / RECORDINGS)
        except BaseException:
            if kept := len([*(folder / RECORDINGS).glob("*.csv")]):
                print(f"{shown(folder)}/{RECORDINGS}/ holds {kept} of {len(EXPERIMENTS)} experiments; next:")
                words = as_word("from", shown(folder)), *words_given("cart", "pole", "control_period")
                print("cartpole-identify", *words)
            else:  # the folder stays free for the next attempt
                for name in (CONFIG, PROVENANCE):
                    (folder / name).unlink(missing_ok=True)  # or its error would hide the first
            raise
    files = experiments(source)
    loaded = {name: read_recording(path) for name, path in files.items()}
    recorded = {name: each.episode for name, each in loaded.items()}
    check_same_encoders({str(files[name]): episode for name, episode in recorded.items()}, config.hardware)
    if config.source is not None:
        warn_of_another_pole(config.pole.nominal, loaded.values())
    fitted, held_out = split(recorded)
    by_file, held_out_by_file = (
        {str(files.get(name, name)): episode for name, episode in chosen.items()}
        for chosen in (fitted, held_out)
    )
    with progress_bar(None, "steps", desc="checking", leave=False) as bar:
        check_recordings(by_file, held_out_by_file, config.control_period, bar.update)
    measured = shared_period(by_file | held_out_by_file)
    if not math.isclose(measured, config.control_period, rel_tol=CLOCK):
        given = f"control_period={config.control_period:g}"
        line = f"note: the recordings have a period of {measured:g} s, which is used in place of {given}"
        print_message("identify", line)
        config = config.model_copy(update={"control_period": measured})
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
    with progress_bar(None, "steps", desc="fitting") as bar, waiting("fitting"):
        found = identify(
            by_file, held_out_by_file, nominal, models, period, substeps, config.windows, laws, bar.update
        )
    with waiting("writing the results"):
        carts = found.fit.draw(max(config.carts, JUDGED), np.random.default_rng(config.seed))
        write_choices(found, carts, config.carts, folder, config.hardware)
        write_json(folder / IDENTIFIED, results(found, carts) | errors(found.fit.parameters, truth, BY_HAND))
        for name, figure in identification_figures(found, carts, fitted, held_out).items():
            save(figure, folder / FIGURES / f"{name}.png")
        identified = intervals(found.fit, carts)
        page = identification_page(found, identified, fitted, next_command(found, folder))
        write_text(folder / PAGE, page)
    print(quantities_table(identified))
    print_verdict(found, folder)


def as_recorded(config: IdentifyConfig, words: Sequence[str]) -> IdentifyConfig:
    """Return `config` with the settings of OF_CART of the run that it reads, but those that `words` give.

    Raises ConfigError for words that change a pole which that run did not have.
    """
    if config.source is None or program_of(config.source) != "identify":
        return config
    given, recorded = config.model_dump(mode="json", by_alias=True), recorded_config(config.source)
    taken = {
        name: recorded[name]
        for name in OF_CART
        if name in recorded and recorded[name] != given[name] and not is_given([name], words)
    }
    keys = [key_of(word) for word in words]
    names = {key.removeprefix("cart.") for key in keys if key.startswith("cart.")} & given["cart"].keys()
    if names and "cart" not in keys:  # they change the recorded cart
        changed = {name: given["cart"][name] for name in names}
        taken = {"cart": {**recorded.get("cart", given["cart"]), **changed}, **taken}
    of_pole = [key for key in keys if key.startswith("pole.")]
    if of_pole and "pole" not in keys:  # they change the recorded pole
        pole = deepcopy(recorded.get("pole", given["pole"]))
        for key in of_pole:
            choices, name, number = [*key.split(".")[1:], "", ""][:3]
            if choices != "choices" or not number or name not in (pole.get("choices") or {}):
                own = ", ".join(pole.get("choices") or ("given by its length",))
                raise ConfigError(f"{key}=: from={config.source} has the pole {own}; give pole= with it")
            pole["choices"][name][number] = given["pole"]["choices"][name][number]
        taken = {"pole": pole, **taken}
    if taken:
        print_message("identify", f"note: {' and '.join(taken)} as in from={config.source}")
    return recorded_settings(IdentifyConfig, {**given, **taken}, f"from={config.source}")


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
    print(f"{shown(folder)}/{IDENTIFIED} is written; these values are for comparison, not to train on")


def record_experiments(config: IdentifyConfig, folder: Path) -> None:
    """Run every experiment on the cart, and write each one when it ends."""
    with (
        progress_bar(len(EXPERIMENTS), "experiments") as progress,
        closing(make_plant(config)) as plant,
        precedence(config.plant, config.emulator),
        waiting("experiments", thread=False),  # paints the bar: a stopped terminal must not hold up the cart
    ):
        progress.set_postfix_str(EXPERIMENTS[0].name, refresh=False)
        for number, (experiment, episode) in enumerate(conduct(plant, config.control_period, config.seed)):
            header = {
                "experiment": experiment.name,
                LENGTH: config.pole.nominal.length,
                "control_period_s": config.control_period,
            }
            write_recording(folder / f"{number:02d}_{experiment.name}.csv", episode, header)
            following = EXPERIMENTS[number + 1 : number + 2]
            progress.set_postfix_str(following[0].name if following else "", refresh=False)
            progress.n += 1


def make_plant(config: IdentifyConfig) -> SerialPlant:
    """Connect to the cart that is identified."""
    pole = config.pole.nominal.model_dump()
    plant: SerialPlant = config.plant.build(
        config.emulator, config.control_period, "hanging", tqdm.write, confirm, {**config.cart, **pole}
    )
    return plant


def split(recordings: Episodes) -> tuple[Episodes, Episodes]:
    """Return the recordings to fit, and the held-out ones.

    Held out are the experiment of that name, or else every fifth recording, or the last of fewer than five.
    If they are too short to judge a fit, they are chosen among the long ones. Of a single one, or a single
    long one, the last fifth is held out.
    """
    named = HELD_OUT in recordings and len(recordings) > 1
    held_out = [HELD_OUT] if named else some_of([*recordings])
    seconds = {name: float(np.ptp(episode.time)) for name, episode in recordings.items()}
    if HELD_OUT not in held_out and sum(seconds[name] for name in held_out) < SHORTEST_HELD_OUT:
        held_out = some_of([name for name in recordings if seconds[name] >= SHORTEST_HELD_OUT])
    if held_out:
        fitted = {name: episode for name, episode in recordings.items() if name not in held_out}
        return fitted, {name: recordings[name] for name in held_out}
    longest = max(seconds, key=lambda name: seconds[name])
    episode = recordings[longest]
    end = episode.steps - episode.steps // HELD_OUT_OF
    rest = {f"the last fifth of {longest}": episode.part(end, episode.steps)}
    return {**recordings, longest: episode.part(0, end)}, rest


def some_of(names: Sequence[str]) -> Sequence[str]:
    """Return every fifth of the names, or the last of fewer than five; none of a single one."""
    return names[HELD_OUT_OF - 1 :: HELD_OUT_OF] or names[1:][-1:]


def next_command(found: Identification, folder: Path) -> str:
    """Return the command that trains on carts like the identified one."""
    run, models, period = shown(folder), found.models, found.dynamics.period
    words = [
        "cartpole-train",
        *(as_word(group, run / f"{group}.yaml") for group in ("cart", "pole", "randomization")),
        friction_choice(models.cart_friction, run),
        friction_choice(models.pole_friction, run),
    ]
    if not math.isclose(period, choice("train")["control_period"]):
        words.append(f"control_period={period:g}")
    if no_force_up_to(found.fit.parameters) < min(filter(None, map(abs, choice(FINE)["motors"]))):
        words.append(FINE.replace("/", "="))
    return " ".join(words)


def print_verdict(found: Identification, folder: Path) -> None:
    """Print the prediction error, the warnings and the next command."""
    print(
        "RMS prediction error over one second of held-out motion, with "
        f"cart_friction={found.models.cart_friction}: {error_text(found.error)}"
    )
    for warning in found.warnings:
        print(f"warning: {warning}")
    files = f"{PAGE}, {CART}, {POLE}, {RANDOMIZATION} and {FIGURES}/"
    print_results(folder, files, next_command(found, folder))


def write_choices(
    found: Identification, carts: np.ndarray, count: int, folder: Path, hardware: Hardware
) -> None:
    """Write cart.yaml, pole.yaml, randomization.yaml and posterior.npz into `folder`.

    `carts` [P, N] are drawn from the fit; the first `count` are to train on.
    """
    write_cart(found, carts, folder / CART, hardware)
    for law in found.models[:2]:
        write_friction(law, found.fit.parameters, folder)
    parameters = found.fit.parameters
    pole = Pole(**{name: parameters[name] for name in Pole.model_fields})
    choices = {"choices": {"identified": pole.model_dump()}}
    units = f"# {', '.join(f'{name} in {PARAMETERS[name].unit}' for name in Pole.model_fields)}.\n"
    write_text(folder / POLE, units + yaml.safe_dump(choices, sort_keys=False))
    with replacing(folder / POSTERIOR) as beside, beside.open("wb") as file:  # a path would get ".npz"
        np.savez(
            file,
            names=np.array(CartParameters.names()),
            carts=carts[:, :count],
            identified=np.array(identified_names(found)),
            unknowns=np.array([unknown.name for unknown in found.fit.unknowns]),
            point=found.fit.point,
            covariance=found.fit.covariance,
        )
    absolute = [name for name, line in UNIDENTIFIABLE.items() if "absolute" in line]
    source = {"posterior": "${here}/" + POSTERIOR, "widen": WIDEN, "prior_share": 0.0}
    write_text(
        folder / RANDOMIZATION,
        f"# Carts drawn from the posterior, correlations included; standard deviations times {WIDEN:g}.\n"
        f"# Absolute ranges are in {', '.join(f'{PARAMETERS[name].unit} ({name})' for name in absolute)}.\n"
        + yaml.safe_dump({**source, "ranges": UNIDENTIFIABLE}, sort_keys=False),
    )


def write_cart(found: Identification, carts: np.ndarray, path: Path, hardware: Hardware) -> None:
    """Write the identified cart without its pole; each parameter with its unit and standard error.

    The numbers of its `hardware` are those that were given.
    """
    parameters, models = found.fit.parameters, found.models
    deviations, identified = standard_deviations(carts), identified_names(found)
    lines = [
        "# Identified by cartpole-identify; each number with its unit and standard error. Found with",
        f"# cart_friction={models.cart_friction} and pole_friction={models.pole_friction}; masses and forces "
        f"are relative to the pole's mass, {parameters['pole_mass']:g} kg.",
    ]
    brought = {name for registry in REGISTRIES.values() for law in registry for name in law.brings}
    for name in CartParameters.names():
        if name not in brought.union(Pole.model_fields):
            error = f"+- {deviations[name]:.2g}" if name in identified else "prior value"
            lines.append(f"{name}: {parameters[name]!r}  # {PARAMETERS[name].unit}, {error}")
    lines += ["# Encoders, track and motor, as given", *yaml.safe_dump(hardware.model_dump()).splitlines()]
    write_text(path, "\n".join(lines) + "\n")


def write_friction(law: Law, parameters: Mapping[str, float], folder: Path) -> None:
    """Write a friction law that conf/ does not have as a choice, with the parameters that it brings."""
    if not is_shipped(law.registry.kind, law):
        choice = {"model": str(law), "parameters": {name: parameters[name] for name in law.brings}}
        write_text(folder / f"{law.registry.kind}.yaml", yaml.safe_dump(choice, sort_keys=False))


def friction_choice(law: Law, folder: Path) -> str:
    """Return the choice of a friction law on a command line, after `write_friction` into `folder`."""
    kind = law.registry.kind
    return as_word(kind, law if is_shipped(kind, law) else folder / f"{kind}.yaml")


def standard_deviations(carts: np.ndarray) -> dict[str, float]:
    """Return the standard deviation of each parameter among `carts` [P, N]."""
    return dict(zip(CartParameters.names(), carts.std(1).tolist(), strict=True))


def identified_names(found: Identification) -> list[str]:
    """Return the names of the parameters that were identified, the pole's included."""
    names = [unknown.name for unknown in found.fit.unknowns if unknown.name not in WEIGHED]
    return [*names, *Pole.model_fields]


def results(found: Identification, carts: np.ndarray) -> dict[str, Any]:
    """Return the content of identification.json."""
    deviations = standard_deviations(carts)
    return {
        "cart_friction": found.models.cart_friction,
        "parameters": found.fit.parameters,
        "standard_errors": {name: deviations[name] for name in identified_names(found) if name in deviations},
        "quantities": {
            each.name: {"value": each.value, "low": each.low, "high": each.high, "unit": each.unit}
            for each in intervals(found.fit, carts)
        },
        "candidates": {
            each.cart_friction: {"x_m": each.error.x, "theta_rad": each.error.theta}
            for each in found.candidates
        },
        "held_out_1_s": {
            "x_m": found.error.x,
            "theta_rad": found.error.theta,
            "seconds": found.error.stretches,
            "away_from_upright": found.error.away,
        },
        "residual": {"x_m": float(found.fit.spread[0]), "theta_rad": float(found.fit.spread[1])},
        "warnings": found.warnings,
    }


def known_truth(config: IdentifyConfig) -> EmulatorSettings | None:
    """Return the truth of the emulated cart that the recordings are of; None for any other cart."""
    if config.source is None:
        return config.emulator.of_cart(config.cart) if config.plant.reads_emulator else None
    recorded = recorded_config(config.source)
    try:
        of_emulator = recorded["plant"]["kind"] == "emulated"
        truth = validated(EmulatorSettings, recorded["emulator"])
        return truth.of_cart(recorded["cart"]) if of_emulator else None
    except (LookupError, TypeError, ConfigError):  # recordings of another origin
        return None


def errors(
    found: Mapping[str, float], truth: EmulatorSettings | None, not_estimated: Collection[str] = ()
) -> dict[str, Any]:
    """Return `errors` for identification.json: relative errors and their median; {} without a truth.

    Parameters that were `not_estimated` have no error.
    """
    if truth is None:
        return {}
    true = true_values(truth)
    values = {**found, "force": force(found)}
    relative = {
        name: abs(values[name] / value - 1)
        for name, value in true.items()
        if value and name not in not_estimated
    }
    return {"errors": {**relative, "median": statistics.median(relative.values())}}


def true_values(truth: EmulatorSettings) -> dict[str, float]:
    """Return the true values of what is compared: those of SAME, dry friction N, and the force at MOTOR N."""
    curve = dict(zip(("force_quadratic", "force_linear", "force_offset"), truth.force_curve, strict=True))
    return {
        **{name: getattr(truth, name) for name in SAME},
        "cart_coulomb": (truth.cart_coulomb_left + truth.cart_coulomb_right) / 2,
        "force": force({**curve, "force_asymmetry": truth.force_asymmetry}),
    }


def force(cart: Mapping[str, float]) -> float:
    """Return the mean force to both sides at MOTOR, N."""
    curve = (cart["force_quadratic"] * MOTOR + cart["force_linear"]) * MOTOR + cart["force_offset"]
    return curve * (1 + cart["force_asymmetry"] / 2)
