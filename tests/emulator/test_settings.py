"""The emulator's settings are complete, documented and strict."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from cartpole_rl.emulator.settings import EmulatorSettings

PAGE = (Path(__file__).parents[2] / "docs" / "emulator.md").read_text(encoding="utf-8")
TRUTH = {
    "masses": ["cart_mass", "pole_mass", "pole_com", "pole_inertia", "track_half_length", "track_tilt"],
    "cart": ["cart_viscous", "cart_coulomb_left", "cart_coulomb_right", "cart_stiction_ratio"],
    "gears": ["cogging", "cogging_pitch"],
    "pole": ["pole_viscous", "pole_coulomb", "pole_drag", "angle_offset"],
    "motor": ["force_curve", "force_asymmetry", "deadband_left", "deadband_right", "motor_time_constant"],
    "link": ["latency", "latency_jitter", "frame_loss", "frame_corruption"],
    "order": ["frame_duplication", "frame_reordering"],
}
NAMES = sorted(name for names in TRUTH.values() for name in names)
FAULTS = ["unplug_at", "reset_at", "stuck_encoder", "stuck_at"]
OURS = [
    "boot",
    "clock",
    "clock_rate",
    "firmware",
    "journal",
    "knock",
    "physics_step",
    "policy",
    "port",
    "seed",
    "start",
    *FAULTS,
]


def test_the_names_are_the_public_ones():
    assert sorted(EmulatorSettings.model_fields) == sorted(NAMES + OURS)


@pytest.mark.parametrize(
    "wrong",
    [
        {"cart_masss": 0.7},
        {"cart_mass": -1.0},
        {"cart_mass": float("nan")},
        {"pole_inertia": 0.0},
        {"cart_stiction_ratio": 0.9},
        {"force_curve": [0.0, 0.02]},
        {"force_curve": [0.0, float("inf"), 0.0]},
        {"frame_loss": 1.0},
        {"latency": -0.001},
        {"clock": "sundial"},
        {"start": "sideways"},
        {"physics_step": 0.002},
        {"seed": -1},
        {"frame_duplication": 1.0},
        {"frame_reordering": -0.1},
        {"unplug_at": 0.0},
        {"reset_at": -1.0},
        {"stuck_encoder": "motor"},
        {"stuck_at": 3.0},
        {"boot": "upright"},
    ],
)
def test_wrong_settings_are_refused_by_name(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        EmulatorSettings(**wrong)


def test_settings_survive_json():
    settings = EmulatorSettings(seed=4, force_curve=(0.0, 0.02, -1.0))
    assert EmulatorSettings.model_validate_json(settings.model_dump_json()) == settings


@pytest.mark.parametrize("name", [*FAULTS, *OURS])
def test_the_page_names(name):
    assert f"`{name}`" in PAGE


@pytest.mark.parametrize("name", NAMES)
def test_the_page_states_the_default(name):
    value = getattr(EmulatorSettings(), name)
    named = {
        "deadband_right": "_right",
        "frame_corruption": "_corruption",
        "frame_reordering": "_reordering",
    }.get(name, name)
    row = next(line for line in PAGE.splitlines() if line.startswith("| `") and f"`{named}`" in line)
    truths = {float(cell) for cell in row.split("|")[3].split(",")}
    assert set(value if isinstance(value, tuple) else (value,)) <= truths
