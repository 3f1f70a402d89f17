"""Errors of identified parameters where the truth is known: on the emulated cart."""

import statistics
from collections.abc import Collection, Mapping
from typing import Any

import yaml

from cartpole_rl.checking import checked
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.settings import EmulatedSettings
from cartpole_rl.run_folder import CONFIG
from cartpole_rl.workflows.config import IdentifyConfig

BY_HAND = ("pole_mass", "pole_com")  # `unknowns.WEIGHED` as parameters: measured with scales and a ruler
MOTOR = 200  # motor value of the force that is compared; coefficients of a curve are not comparable
SAME = ("cart_mass", "pole_mass", "pole_com", "cart_viscous", "pole_viscous")  # names on both sides


def known_truth(config: IdentifyConfig) -> EmulatorSettings | None:
    """Return the truth of the emulated cart that the recordings are of; None for any other cart."""
    if config.source is None:
        return config.emulator if isinstance(config.plant, EmulatedSettings) else None
    try:
        recorded = yaml.safe_load((config.source / CONFIG).read_text(encoding="utf-8"))
        of_emulator = recorded["plant"]["kind"] == "emulated"
        return checked(EmulatorSettings, recorded["emulator"]) if of_emulator else None
    except (OSError, yaml.YAMLError, LookupError, TypeError, ConfigError):  # recordings of another origin
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
