"""A second signal, while a command that homes a cart ends because of a first one, changes nothing."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from serial_peer import INFO, HomingForever, wait_for

from cartpole_rl.signals import UNWINDING
from cartpole_rl.wire.messages import Flags, Home, Stop

PREFLIGHT = (sys.executable, "-m", "cartpole_rl.cli", "preflight")


def test_the_exit_code_is_that_of_the_first_signal(tmp_path: Path) -> None:
    """It comes while the cart is being stopped, and again and again until the interpreter is gone."""
    with HomingForever() as peer:
        peer.info = replace(INFO, soft_limit_counts=16704, hard_limit_counts=17539)
        words = ["plant=serial", f"plant.port={peer.port}", f"hydra.run.dir={tmp_path}"]
        with subprocess.Popen(
            [*PREFLIGHT, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            wait_for(lambda: bool(peer.messages(Home)), 200)
            stops = len(peer.messages(Stop))
            process.send_signal(signal.SIGTERM)
            taken = time.monotonic()
            wait_for(lambda: len(peer.messages(Stop)) > stops, 200)
            while process.poll() is None and time.monotonic() < taken + UNWINDING / 2:
                process.send_signal(signal.SIGINT)
                time.sleep(0.01)
            process.communicate(timeout=200)
        assert process.returncode == 128 + signal.SIGTERM
    assert peer.flags == Flags(0)
