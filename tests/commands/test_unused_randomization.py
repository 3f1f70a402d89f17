"""cartpole-train names the ranges that change nothing."""

from pathlib import Path
from typing import Any

import pytest

from cartpole_rl.envs.build import randomizer
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import print_notes

DEADBANDS = {
    "+randomization.deadband_left": {"absolute": [0, 60]},
    "+randomization.deadband_right": {"absolute": [0, 110]},
}
SLOPE = {"+randomization.sigmoid_slope": {"factor": [0.5, 2]}}


@pytest.fixture
def notes(capsys: pytest.CaptureFixture[str]) -> Any:
    def told(**settings: Any) -> str:
        config = load_settings(TrainConfig, settings)
        print_notes(config, randomizer(config), config.models(config.plant))
        return "".join(line for line in capsys.readouterr().err.splitlines() if "note:" in line)

    return told


def test_ranges_without_effect_are_named(notes: Any) -> None:
    assert notes(**DEADBANDS, **SLOPE, cart_friction="step") == (
        "cartpole-train: note: randomization of deadband_left, sigmoid_slope has no effect with "
        "cart_friction=step, pole_friction=exponential and actuator force_curve with motor values "
        "[-250, -200, -150, -100, 0, 100, 150, 200, 250]"
    )


def test_a_cart_outside_its_ranges_is_named(notes: Any) -> None:
    assert notes(**{"cart.latency": 0.05}).endswith(
        "cartpole-train: note: the cart's latency is 0.05, but randomization.latency draws 0 to 0.022: the "
        "agent is evaluated on a cart that it does not learn on; give a randomization= that holds it "
        "(docs/randomization.md)"
    )


def test_a_number_that_no_identified_cart_has_is_named(notes: Any, tmp_path: Path) -> None:
    (tmp_path / "carts.csv").write_text("cart_viscous,latency\n1.0,0.004\n1.2,0.006\n")
    identified = {"randomization": {"posterior": str(tmp_path / "carts.csv"), "prior_share": 0.0}}
    found = notes(**identified, **{"cart.cart_viscous": 2.0, "cart.latency": 0.005})
    assert "the cart's cart_viscous is 2, but randomization.posterior draws 1 to 1.2: the agent is" in found
    assert "latency" not in found


def test_there_is_no_note_where_all_have_an_effect(notes: Any) -> None:
    assert notes() == ""
