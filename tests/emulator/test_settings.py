"""The emulator's settings are complete, documented and strict.

The default truth is that of docs/emulator.md, and each difference from the nominal cart is as it says.
"""

import math
import re
from pathlib import Path
from typing import NamedTuple

import pytest
from pydantic import ValidationError

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings

PAGE = (Path(__file__).parents[2] / "docs" / "emulator.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "wrong",
    [
        {"cart_masss": 0.7},
        {"cart_mass": -1.0},
        {"cart_mass": float("nan")},
        {"cart_mass": 1e-16},
        {"pole_mass": 1e-16},
        {"pole_inertia": 1e-13},
        {"cart_stiction_ratio": 0.9},
        {"force_curve": [0.0, float("inf"), 0.0]},
        {"frame_loss": 1.0},
        {"latency": -0.001},
        {"clock": "sundial"},
        {"physics_step": 0.002},
        {"stuck_at": 3.0},
    ],
)
def test_wrong_settings_are_refused_by_name(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        EmulatorSettings(**wrong)


def test_the_page_names_every_setting():
    """`deadband_right` is shortened there; `backdrivability` is a number of a cart's file."""
    unnamed = {name for name in EmulatorSettings.model_fields if f"`{name}`" not in PAGE}
    assert unnamed == {"deadband_right", "backdrivability"}


LEVELS = choice("actions/nine_levels")["motors"]
CART = {**choice("cart/ip02"), **choice("pole/medium")["choices"]["medium"]}
CURVE = (CART["force_quadratic"], CART["force_linear"], CART["force_offset"])
OTHERWISE = {  # numbers that conf/ has under another name or does not have
    "track_half_length": CART["track_half_length"] + CART["soft_limit"],
    "cart_coulomb_left": CART["cart_coulomb"] * (1 - CART["cart_coulomb_asymmetry"]),
    "cart_coulomb_right": CART["cart_coulomb"] * (1 + CART["cart_coulomb_asymmetry"]),
    "force_curve": CURVE,
    "cogging": 0.0,
    **dict.fromkeys(("frame_loss", "frame_corruption", "frame_duplication", "frame_reordering"), 0.0),
}


class Row(NamedTuple):
    """A line of the table."""

    names: list[str]
    nominal: list[float | None]  # None: the simulator has no such number
    truth: list[float]
    off_by: list[str]


def row_of(line: str) -> Row:
    setting, nominal, truth, off_by = [cell.strip() for cell in line.split("|")[1:5]]
    names = re.findall(r"`(\w+)`", setting)
    names = [names[0].rsplit("_", 1)[0] + name if name.startswith("_") else name for name in names]
    values = [None if value == "none" else float(value) for value in nominal.split(", ")]
    truths = [float(value) for value in truth.split(", ")]
    return Row(names, values, truths, [off for off in off_by.split(", ") if off])


TABLE = PAGE.split("| reason |\n")[1].split("\n\n")[0].splitlines()[1:]
ROWS = [row_of(line) for line in TABLE]
by_name = pytest.mark.parametrize("row", ROWS, ids=[row.names[0] for row in ROWS])


def flat(values: list[object]) -> list[object]:
    return [each for value in values for each in (value if isinstance(value, tuple) else (value,))]


def nominal(name: str) -> object:
    return OTHERWISE.get(name, CART.get(name))


@by_name
def test_the_nominal_cart_is_that_of_conf(row: Row) -> None:
    expected = flat([nominal(name) for name in row.names])
    assert row.nominal == [None if value is None else pytest.approx(value, abs=1e-5) for value in expected]


@by_name
def test_the_truth_is_that_of_the_settings(row: Row) -> None:
    assert row.truth == flat([getattr(EmulatorSettings(), name) for name in row.names])


@by_name
def test_the_difference_is_that_of_the_table(row: Row) -> None:
    if row.names == ["force_curve"]:
        shares = [
            force(EmulatorSettings().force_curve, size) / force(CURVE, size) - 1 for size in LEVELS if size
        ]
        assert max(shares) - min(shares) < 1e-9
        off = [shares[0]]
    elif row.names == ["force_asymmetry"]:
        off = row.truth
    else:
        off = [truth / usual - 1 for truth, usual in zip(row.truth, row.nominal, strict=True) if usual]
    assert row.off_by == [shown(share, printed) for share, printed in zip(off, row.off_by, strict=True)]


def force(curve: tuple[float, float, float], motor: int) -> float:
    """Return the force of a curve, N, for a motor value of either sign."""
    a, b, c = curve
    return math.copysign(max(0.0, a * motor**2 + b * abs(motor) + c), motor)


def shown(share: float, like: str) -> str:
    """Return a share in per cent, with as many digits as `like`."""
    digits = len(like.partition(".")[2].removesuffix(" %"))
    rounded = round(100 * share, digits)
    return f"{rounded:+.{digits}f} %" if rounded else "0 %"
