"""scripts/fuzz/two_firmwares.py in short: both firmwares agree, and a firmware that differs is found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import two_firmwares
from bench_scripts import SCRIPTS
from firmwares import needs_compiler

from cartpole_rl.emulator import c_firmware
from cartpole_rl.rig.hardware import hardware_of

pytestmark = needs_compiler
SHORT, LONG = (8_000, 1_500), (20_000, 3_000)  # random bytes and frames
OTHER = {
    "cart_nanometres_per_count": 98_175,
    "pole_counts_per_turn": 1001,
    "track_span": 0.3961,
    "soft_limit": 0.02,
    "hard_limit": 0.0053,
    "braking": 1.3,
    "hard_push": 150,
    "moving_mass": 0.31,
    "moving_friction": 0.27,
    "motor_offset": 31.5,
    "motor_per_newton": 90.3,
    "gentle_force": 1.7,
    "left_switch": 1,
    "right_switch": 1,
}


@pytest.mark.parametrize(
    ("rig", "seed", "counted", "size"),
    [
        pytest.param({}, "24", " 1 POLE_ENCODER,", SHORT, id="ip02, with failing encoders"),
        pytest.param(OTHER, "63", " 2 homings,", SHORT, id="other, with switches, homed and driven"),
        pytest.param({}, "3", " 2 POLE_ENCODER,", LONG, id="ip02, longer", marks=pytest.mark.nightly),
        pytest.param(OTHER, "6", " 1 homings,", LONG, id="other, longer", marks=pytest.mark.nightly),
    ],
)
def test_both_firmwares_agree_under_sanitizers(
    rig: dict[str, float], seed: str, counted: str, size: tuple[int, int]
) -> None:
    compiler = c_firmware.find_compiler()
    found = subprocess.run([compiler, "-print-file-name=libasan.so"], capture_output=True, text=True)
    if not Path(found.stdout.strip()).is_absolute():
        pytest.skip("needs the address sanitizer of gcc")
    command = [sys.executable, str(SCRIPTS / "fuzz" / "two_firmwares.py")]
    words = ["--bytes", f"{size[0]}", "--frames", f"{size[1]}", "--seed", seed, "--rig", json.dumps(rig)]
    done = subprocess.run([*command, *words], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "no difference" in done.stdout
    assert counted in done.stdout


OTHER_RIG = c_firmware.definitions(hardware_of({"moving_mass": 0.86}))
FEWER_WAIT = (
    *(flag for flag in c_firmware.FLAGS if not flag.startswith("-DCART_PENDING")),
    "-DCART_PENDING=1",
)


@pytest.mark.parametrize(
    ("name", "value"), [("definitions", lambda hardware: OTHER_RIG), ("FLAGS", FEWER_WAIT)]
)
def test_another_rig_or_number_of_waiting_commands_is_a_difference(
    name: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(c_firmware, name, value)
    with pytest.raises(two_firmwares.DifferenceError, match="differ"):
        two_firmwares.run(1000, 8000, seed=1)
