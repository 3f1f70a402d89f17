"""Files of an identification: the cart, its pole and carts to train on, as choices for conf/'s groups."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cartpole_rl.choices import is_shipped
from cartpole_rl.files import replacing, write_text
from cartpole_rl.identification.identify import Identification
from cartpole_rl.identification.quantities import intervals
from cartpole_rl.identification.unknowns import WEIGHED
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import REGISTRIES
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.run_folder import CART, POLE, POSTERIOR, RANDOMIZATION

UNIDENTIFIABLE = {  # randomized about the identified cart, since no experiment shows them
    "track_half_length": {"distribution": "uniform", "relative": [-0.1, 0.0]},
    "latency_jitter": {"distribution": "uniform", "absolute": [0.0, 0.002]},
}
WIDEN = 2.0  # factor on the standard deviations, for carts to train on


def write_choices(found: Identification, carts: np.ndarray, folder: Path) -> None:
    """Write cart.yaml, pole.yaml, randomization.yaml and posterior.npz into `folder`.

    `carts` [P, N] are drawn from the fit.
    """
    write_cart(found, carts, folder / CART)
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
            carts=carts,
            identified=np.array(identified_names(found)),
            unknowns=np.array([unknown.name for unknown in found.fit.unknowns]),
            point=found.fit.point,
            covariance=found.fit.covariance,
        )
    absolute = [name for name, line in UNIDENTIFIABLE.items() if "absolute" in line]
    randomization = {
        "posterior": "${here}/" + POSTERIOR,
        "widen": WIDEN,
        "prior_share": 0.0,
        "ranges": UNIDENTIFIABLE,
    }
    write_text(
        folder / RANDOMIZATION,
        f"# Carts drawn from the posterior, correlations included; standard deviations times {WIDEN:g}.\n"
        f"# Absolute ranges are in {', '.join(f'{PARAMETERS[name].unit} ({name})' for name in absolute)}.\n"
        + yaml.safe_dump(randomization, sort_keys=False),
    )


def write_cart(found: Identification, carts: np.ndarray, path: Path) -> None:
    """Write the identified cart without its pole; each parameter with its unit and standard error."""
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
    write_text(path, "\n".join(lines) + "\n")


def write_friction(law: Law, parameters: Mapping[str, float], folder: Path) -> None:
    """Write a friction law that conf/ does not have as a choice, with the parameters that it brings."""
    if not is_shipped(law.registry.kind, law):
        choice = {"model": str(law), "parameters": {name: parameters[name] for name in law.brings}}
        write_text(folder / f"{law.registry.kind}.yaml", yaml.safe_dump(choice, sort_keys=False))


def friction_choice(law: Law, folder: Path) -> str:
    """Return the choice of a friction law on a command line, after `write_friction` into `folder`."""
    kind = law.registry.kind
    return f"{kind}={law if is_shipped(kind, law) else f'{folder}/{kind}.yaml'}"


def standard_deviations(carts: np.ndarray) -> dict[str, float]:
    """Return the standard deviation of each parameter among `carts` [P, N]."""
    return dict(zip(CartParameters.names(), carts.std(1).tolist(), strict=True))


def identified_names(found: Identification) -> list[str]:
    """Return the names of the parameters that were identified, the pole's included."""
    names = [unknown.name for unknown in found.fit.unknowns if unknown.name not in WEIGHED]
    return [*names, *Pole.model_fields]


def report(found: Identification, carts: np.ndarray) -> dict[str, Any]:
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
        "held_out_1_s": {"x_m": found.error.x, "theta_rad": found.error.theta},
        "residual_counts": found.fit.rms.tolist(),
        "warnings": found.warnings,
    }
