"""A uniform rod: the thesis's model of poles of any length."""

from typing import Any

# From the thesis (6.4). Quanser's poles have half of it, 0.127 kg on 0.3365 m and 0.230 kg on 0.6413 m:
# 0.7 kg/m is their mass over the distance from pivot to centre of mass.
POLE_DENSITY = 0.7  # kg/m


def uniform_rod(length: Any) -> dict[str, Any]:
    """Return mass, centre of mass and inertia of a rod of POLE_DENSITY: its length sets all three.

    `length` m is a float or a tensor, and so are the three.
    """
    mass = POLE_DENSITY * length
    return {"pole_mass": mass, "pole_com": length / 2, "pole_inertia": mass * length**2 / 12}
