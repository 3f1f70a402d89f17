"""scripts/fuzz/two_firmwares.py in short: both firmwares agree, and a firmware that differs is found."""

import subprocess
import sys
from pathlib import Path

import pytest
import two_firmwares
from bench_scripts import SCRIPTS
from firmwares import needs_compiler

from cartpole_rl.emulator import c_firmware

pytestmark = needs_compiler
SHORT = ("--bytes", "50000", "--frames", "8000")


def run_script(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPTS / "fuzz" / "two_firmwares.py"), *words]
    return subprocess.run(command, capture_output=True, text=True)


def test_both_firmwares_agree_under_sanitizers() -> None:
    compiler = c_firmware.find_compiler()
    found = subprocess.run([compiler, "-print-file-name=libasan.so"], capture_output=True, text=True)
    if not Path(found.stdout.strip()).is_absolute():
        pytest.skip("needs the address sanitizer of gcc")
    done = run_script(*SHORT)
    assert (done.returncode, done.stderr) == (0, "")
    assert "no difference" in done.stdout


@pytest.mark.parametrize("flag", ["-DCART_NANOMETRES=22760", "-DCART_SPAN_UM=830000", "-DCART_PENDING=1"])
def test_another_cart_is_a_difference(flag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    others = [other for other in c_firmware.CART if other.split("=")[0] != flag.split("=")[0]]
    monkeypatch.setattr(c_firmware, "CART", (*others, flag))
    with pytest.raises(two_firmwares.DifferenceError, match="differ"):
        two_firmwares.run(1000, 8000, seed=1)
