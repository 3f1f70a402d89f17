"""cartpole-train names the ranges that change nothing, and trains."""

from pathlib import Path

import pytest
from command_line import ONCE, TINY, in_process

DEADBANDS = (
    "+randomization.deadband_left={absolute:[0,60]}",
    "+randomization.deadband_right={absolute:[0,110]}",
)
SLOPE = "+randomization.sigmoid_slope={factor:[0.5,2]}"


pytestmark = pytest.mark.usefixtures("without_pictures")


def note(folder: Path, *words: str) -> str:
    done = in_process("train", *TINY, ONCE, *words, "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    return "".join(line for line in done.err.replace("\r", "\n").splitlines() if "note:" in line)


def test_ranges_without_effect_are_named(tmp_path: Path) -> None:
    told = note(tmp_path, *DEADBANDS, SLOPE, "cart_friction=step")
    assert told == (
        "cartpole-train: note: randomization of deadband_left, sigmoid_slope has no effect with "
        "cart_friction=step, pole_friction=exponential and actuator force_curve with motor values "
        "[-250, -200, -150, -100, 0, 100, 150, 200, 250]"
    )


def test_a_cart_outside_its_ranges_is_named(tmp_path: Path) -> None:
    assert note(tmp_path, "cart.latency=0.05").endswith(
        "cartpole-train: note: the cart's latency is 0.05, but randomization.latency draws 0 to 0.022: the "
        "agent is evaluated on a cart that it does not learn on; give a randomization= that holds it "
        "(docs/randomization.md)"
    )


def test_there_is_no_note_where_all_have_an_effect(tmp_path: Path) -> None:
    assert note(tmp_path) == ""
