"""The emulator's settings are complete, documented and strict."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from cartpole_rl.emulator.settings import EmulatorSettings

PAGE = (Path(__file__).parents[2] / "docs" / "emulator.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "wrong",
    [
        {"cart_masss": 0.7},
        {"cart_mass": -1.0},
        {"cart_mass": float("nan")},
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


def test_settings_survive_json():
    settings = EmulatorSettings(seed=4, force_curve=(0.0, 0.02, -1.0))
    assert EmulatorSettings.model_validate_json(settings.model_dump_json()) == settings


def test_the_page_names_every_setting():
    """`deadband_right` is shortened there; `backdrivability` is a number of a cart's file."""
    unnamed = {name for name in EmulatorSettings.model_fields if f"`{name}`" not in PAGE}
    assert unnamed == {"deadband_right", "backdrivability"}
