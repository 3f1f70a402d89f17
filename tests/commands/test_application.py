"""Response of every command to signals that end it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import pytest
from command_line import HANDLED, in_process
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn

from cartpole_rl import cli
from cartpole_rl.cli import VERBS
from cartpole_rl.command import run_command
from cartpole_rl.exits import Terminated
from cartpole_rl.signals import UNWINDING, RaiseOnce, ending_signals
from cartpole_rl.workflows.find_port import FindPortConfig

pytestmark = pytest.mark.usefixtures("same_signals")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_unwinds_the_work(number: signal.Signals, code: int, tmp_path: Path) -> None:
    """Every `with` then stops its motor."""
    happened: list[str] = []

    def main(config: FindPortConfig) -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(5)
            happened.append("went on")
        finally:
            happened.append("unwound")

    signal.signal(number, signal.SIG_DFL)
    done = in_process("find_port", folder=tmp_path, function=main)
    assert (happened, done.code, done.err) == (["unwound"], code, "cartpole-find-port: terminated\n")


def test_an_interrupt_during_the_first_imports_is_silent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cartpole_rl.command.run_command", interrupted)
    with pytest.raises(SystemExit) as ended:
        cli.train()
    assert ended.value.code == 130
    assert capsys.readouterr() == ("", "")


def test_a_second_signal_does_not_interrupt_the_unwinding(monkeypatch: pytest.MonkeyPatch) -> None:
    """A `with` that stops a motor completes; a program that hangs can be ended later."""
    handler = RaiseOnce(lambda number: InterruptedError(number))
    handler.handle(*HANDLED)
    with pytest.raises(InterruptedError, match=str(int(signal.SIGHUP))):
        os.kill(os.getpid(), signal.SIGHUP)
    for number in HANDLED:
        os.kill(os.getpid(), number)
    clock = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: clock + 2 * UNWINDING)
    with pytest.raises(InterruptedError, match=str(int(signal.SIGTERM))):
        os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_that_python_swallowed_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    swallowed = []
    monkeypatch.setattr(sys, "unraisablehook", swallowed.append)
    RaiseOnce(lambda number: InterruptedError(number)).handle(signal.SIGTERM)

    class Destroyed:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    Destroyed()
    started = time.monotonic()
    with pytest.raises(InterruptedError):
        time.sleep(600)
    assert time.monotonic() - started < 300  # it interrupts what waits
    assert len(swallowed) == 1


def test_a_later_signal_while_the_program_exits_is_ignored() -> None:
    """Also while the exit functions of packages run that were imported after the first lines."""
    program = (
        "import atexit, os, signal; from cartpole_rl import signals; signals.UNWINDING = 0; "
        "signals.RaiseOnce(lambda number: SystemExit(128 + number)).handle(signal.SIGTERM); "
        "atexit.register(os.kill, os.getpid(), signal.SIGTERM); os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (143, "")


def test_a_hangup_that_nohup_ignores_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert ending_signals() == [signal.SIGTERM]
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    assert ending_signals() == [signal.SIGTERM, signal.SIGHUP]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no device that is always full")
def test_a_full_disk_ends_a_command_with_one_line(tmp_path: Path) -> None:
    def main(config: FindPortConfig) -> None:
        Path("/dev/full").write_text("as a log that is appended to")

    done = in_process("find_port", folder=tmp_path, function=main)
    assert done.code == 1
    assert done.complaint.startswith("cartpole-find-port: a file was not written: No space left on dev")


def test_a_pipe_without_a_reader_ends_a_command_quietly() -> None:
    """As in `cartpole-train --cfg job | head -1`, once `head` has ended."""
    program = (
        "from cartpole_rl.exits import exit_with_message\n"
        "try:\n"
        "    print('x' * 100_000)\n"
        "except OSError as error:\n"
        "    exit_with_message('train', error)\n"
    )
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


class FreshLauncher(BasicLauncher):
    """Starts jobs with the signals that a new process has, as joblib's workers do."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Launch them."""
        for number in HANDLED:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        return super().launch(job_overrides, initial_job_idx)


@pytest.fixture
def fresh_launcher() -> str:
    Plugins.instance().register(FreshLauncher)
    target = f"{FreshLauncher.__module__}.{FreshLauncher.__name__}"
    ConfigStore.instance().store(group="hydra/launcher", name="fresh", node={"_target_": target})
    return "hydra/launcher=fresh"


def test_a_job_in_a_process_of_its_own_unwinds_after_a_signal(
    fresh_launcher: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str] = []

    def main(config: FindPortConfig) -> None:
        assert isinstance(signal.getsignal(signal.SIGTERM), RaiseOnce)  # or pytest would end here
        with pytest.raises(Terminated):
            signal.raise_signal(signal.SIGTERM)
        happened.append("unwound")

    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    with patch("sys.argv", ["cartpole-find-port", "-m", fresh_launcher]):
        run_command("find_port", VERBS["find_port"]._replace(function=main))
    assert happened == ["unwound"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL  # as the launcher left it


def test_a_job_that_a_signal_ended_ends_its_process_by_that_signal() -> None:
    """So that the launcher reports it."""
    program = (
        "import os, signal, time\n"
        "from cartpole_rl.exits import job_signals\n"
        "with job_signals():\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        time.sleep(5)\n"
        "    finally:\n"
        "        print('unwound', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("unwound\n", -signal.SIGTERM)
