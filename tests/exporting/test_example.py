"""examples/drive_without_torch.py swings up the pole of an emulated cart, and PyTorch is never imported."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serial_peer import CartPeer

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError
from cartpole_rl.exporting.agent import ExportedAgent, observed_numbers
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.tasks.settings import Start
from cartpole_rl.wire.messages import Flags, SetMotor
from examples.drive_without_torch import main

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/drive_without_torch.py"
SCRIPT = f"""
import runpy, sys
runpy.run_path({str(EXAMPLE)!r}, run_name="__main__")
assert not {{"torch", "tensordict", "torchrl"}} & {{*sys.modules}}
"""

pytest.importorskip("mujoco", reason='mujoco is missing: pip install "cartpole_rl[emulator]"')


def written(agent: ExportedAgent, folder: Path) -> Path:
    (folder / "agent.npz").write_bytes(agent.weights_file())
    return folder / "agent.npz"


@pytest.fixture
def file(exported: ExportedAgent, tmp_path: Path) -> Path:
    return written(exported, tmp_path)


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """The exit status, stdout and stderr; a traceback is an error."""
    out, err = process.communicate()
    assert "Traceback" not in err, err
    return process.returncode, out, err


def taken(journal: Path) -> list[str]:
    """The commands that the emulated cart carried out."""
    lines = [json.loads(line) for line in journal.read_text().splitlines() if line.endswith("}")]
    return [line["took"] for line in lines if "took" in line]


def driven(file: Path, journal: Path, **emulator: Any) -> tuple[int, str, str]:
    with EmulatedCart(EmulatorSettings(physics_step=1e-3, journal=journal, **emulator)) as cart:
        return ended(started(file, cart.port))


def test_the_example_swings_up_and_balances(file: Path, tmp_path: Path) -> None:
    journal = tmp_path / "journal.jsonl"
    code, out, err = driven(file, journal)
    assert code == 0, err
    assert float(out.split()[-2]) > 7.0  # of 10 s
    assert taken(journal)[-1] == "STOP"


def test_two_interrupts_stop_the_cart(file: Path, tmp_path: Path) -> None:
    journal = tmp_path / "journal.jsonl"
    with EmulatedCart(EmulatorSettings(physics_step=1e-3, journal=journal)) as cart:
        process = started(file, cart.port)
        while "START" not in taken(journal):
            assert process.poll() is None
            time.sleep(0.02)
        for _ in range(2):
            process.send_signal(signal.SIGINT)
        code, out, err = ended(process)
    # the second may come after the end of the program, while the interpreter ends
    assert code in (128 + signal.SIGINT, -signal.SIGINT)
    assert (out, err) == ("", "")
    assert taken(journal)[-1] == "STOP"


def check_refused(text: str, *arguments: str | Path) -> None:
    with pytest.raises(CartPoleError, match=re.escape(text)) as raised:
        main(*arguments)
    assert "\n" not in str(raised.value)


def test_wrong_arguments_are_named_in_one_line(file: Path, tmp_path: Path) -> None:
    usage = "usage: drive_without_torch.py AGENT.npz PORT [POLE_LENGTH]"
    missing = f"{tmp_path}/nowhere.npz: there is no such file"
    for arguments, text in (((file,), usage), ((tmp_path / "nowhere.npz", "/dev/null"), missing)):
        code, _, err = ended(started(*arguments))
        assert code == 1
        assert err.startswith(text)
        assert err.count("\n") == 1
    check_refused("port", file, str(tmp_path / "port"))
    check_refused("POLE_LENGTH: 'long' is not a number", file, "no port", "long")


def test_an_agent_that_observes_the_length_needs_it_before_the_port_opens(
    exported: ExportedAgent, tmp_path: Path
) -> None:
    about = exported.description
    observation = about.observation.model_copy(update={"pole_length": True})
    changes = {"observation": observation, "numbers": observed_numbers(observation)}
    sizes = (about.sizes[0] + 1, *about.sizes[1:])
    first = exported.layers[0]
    wider = first._replace(weight=np.pad(first.weight, ((0, 0), (0, 1))))
    agent = ExportedAgent(about.model_copy(update={**changes, "sizes": sizes}), (wider, *exported.layers[1:]))
    file = written(agent, tmp_path)
    for length in ((), ("nan",), ("355.6",)):
        check_refused("this agent observes the pole's length", file, "no port", *length)


def test_an_agent_that_needs_an_upright_pole_is_refused(exported: ExportedAgent, tmp_path: Path) -> None:
    about = exported.description.model_copy(update={"start": Start.UPRIGHT, "angle_limit": 0.2})
    file = written(replace(exported, description=about), tmp_path)
    check_refused("needs an upright pole", file, "no port")


def test_a_gap_on_the_carts_clock_ends_the_drive(file: Path) -> None:
    class Suspended(CartPeer):
        armed = 0

        def next_state(self, **changes: int) -> bytes:
            self.armed += Flags.ARMED in self.flags
            if self.armed == 50:
                self.before = len(self.received)
                changes["time_us"] = self.state.time_us + 1_500_000
            return super().next_state(**changes)

    with Suspended() as cart:
        code, _, err = ended(started(file, cart.port))
        assert code == 1
        assert "did not answer the cart" in err
        sent = [frame.message for frame in cart.received[cart.before :]]
        assert not any(message.motor for message in sent if isinstance(message, SetMotor))


def test_a_fallen_pole_ends_the_drive(exported: ExportedAgent, tmp_path: Path) -> None:
    about = exported.description.model_copy(update={"angle_limit": 0.2})
    file, journal = written(replace(exported, description=about), tmp_path), tmp_path / "journal.jsonl"
    code, _, err = driven(file, journal)
    assert (code, err) == (1, "the pole fell\n")
    assert taken(journal)[-1] == "STOP"
