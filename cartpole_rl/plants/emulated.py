"""Carts in a process of their own: the emulated cart, and the bridge to a board. Imports no torch."""

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Self

from pydantic import BaseModel

from cartpole_rl.emulator.guards import LEVER
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError, ConfigError, EmulatorError, LinkError
from cartpole_rl.plants.settings import LONGEST_WRITE, BoardSettings, SerialSettings
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.signals import PARENT

LOGGER = logging.getLogger(__name__)

READY_TIMEOUT = 60.0  # s for the first line; the process loads MuJoCo before it
ENDING = 1.0  # s that a process whose port is gone may still need
GRACE = 3.0  # s from SIGTERM to SIGKILL
ASKED = 1 if os.name == "nt" else -signal.SIGTERM  # exit code of a process that was not ready yet
STDERR_BYTES = 2000  # of the end of its stderr, for an error


class CartProcess:
    """A process that serves a cart: `port` to open with pyserial, `pid`. A context manager that ends it.

    The process ends when this one dies. Ctrl-C in a terminal reaches only this process, so the cart can still
    be stopped. Raises EmulatorError if it does not become ready, and at the end of a `with` without another
    error if it had died before.
    """

    what = "the emulated cart"
    board = ""  # the port of the board that it bridges

    def __init__(self, module: str, settings: str) -> None:
        """Start ``python -m module settings``, and wait for its first line."""
        self.told = False  # somebody knows why it ended
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, settings],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            start_new_session=True,
            env={**os.environ, PARENT: str(os.getpid())},
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # the same on Windows
        )
        try:
            self.port = self._read_port()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def died(self) -> str:
        """The reason why the process ended early, with the end of its stderr; empty while it runs."""
        code = self._process.poll()
        return "" if code is None else self._why(code)

    def death(self) -> str:
        """Return `died`; a process that is ending is waited for."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(ENDING)
        return self.died

    def _why(self, code: int) -> str:
        return f"{self.what} ended with exit code {code}: {self._stderr_end()}"

    def _failed(self, code: int) -> CartPoleError:
        """Return the error for a process that did not become ready."""
        return EmulatorError(self._why(code))

    def close(self) -> None:
        """End the process: SIGTERM, and SIGKILL after a grace. Warns if it failed and nobody asked why."""
        process = self._process
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
        if process.wait() not in (0, ASKED) and not self.told:
            LOGGER.warning("%s", self._why(process.returncode))
        assert process.stdout is not None  # a pipe was asked for
        process.stdout.close()
        self._stderr.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        died = self.died
        self.close()
        if died and error is None:
            raise EmulatorError(died)

    def _read_port(self) -> str:
        """Return the port in the JSON line that the process prints when it is ready."""
        assert self._process.stdout is not None  # a pipe was asked for
        lines: SimpleQueue[bytes] = SimpleQueue()  # Windows cannot wait for a pipe with a timeout
        output = self._process.stdout
        Thread(target=lambda: lines.put(output.readline()), daemon=True).start()
        try:
            line = lines.get(timeout=READY_TIMEOUT)
        except Empty:
            raise EmulatorError(f"{self.what} was not ready after {READY_TIMEOUT:g} s") from None
        if not line:
            raise self._failed(self._process.wait(GRACE))
        try:
            return str(json.loads(line)["port"])
        except (ValueError, KeyError, TypeError) as error:
            raise EmulatorError(f"{self.what}'s first line is not JSON with `port`: {line!r}") from error

    def _stderr_end(self) -> str:
        self.told = True
        if self._stderr.closed:
            return "stderr is closed"
        length = self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(0, length - STDERR_BYTES))
        return self._stderr.read().decode(errors="replace").strip() or "it wrote nothing to stderr"


class EmulatedCart(CartProcess):
    """A running emulator of the cart `truth`."""

    def __init__(self, truth: EmulatorSettings) -> None:
        self.truth = truth
        super().__init__("cartpole_rl.emulator", truth.model_dump_json())

    @property
    def settings(self) -> SerialSettings:
        """Settings for a host that drives this cart.

        Without disturbed frames the host repeats a question late: a busy computer then adds no period to a
        lockstep run, which is repeatable. With disturbed frames it repeats early, so that a lost answer costs
        little time. Its system may take a write for stalled when the host was only suspended, hence the long
        write timeout.
        """
        truth = self.truth
        disturbed = bool(truth.frame_loss or truth.frame_corruption or truth.frame_reordering)
        return SerialSettings(
            port=self.port,
            timeout=5.0,
            connect_timeout=10.0,
            answer_timeout=0.1 if disturbed else 2.0,
            retries=20 if disturbed else 2,
            write_timeout=LONGEST_WRITE,
            nudge_after=2.0,
        )


class BridgeProcess(CartProcess):
    """A running bridge to a board with firmware of its own (`plants/drivers/bridge.py`).

    Raises LinkError, PortError or ConfigError, as the bridge does, if it does not become ready.
    """

    what = "the bridge to the cart"

    def __init__(
        self, board: BoardSettings, hardware: Hardware, control_period: float | None, lever: int = LEVER
    ) -> None:
        """`control_period` in s is refused if the board does not measure so; None takes the board's own.

        `lever` is that of `TrackLimits`, um.
        """
        self.board = board.port
        given = {"plant": board, "hardware": hardware, "control_period": control_period, "lever_um": lever}
        super().__init__("cartpole_rl.plants.drivers", json.dumps(given, default=BaseModel.model_dump))

    def _why(self, code: int) -> str:
        if code > 0:
            return self._stderr_end()
        killed = "; the cart's motor may still be on: switch it off" if code < 0 else ""
        return f"{super()._why(code)}{killed}"

    def _stderr_end(self) -> str:
        return super()._stderr_end().splitlines()[-1]  # before it, a driver may have printed anything

    def _failed(self, code: int) -> CartPoleError:
        kind = ConfigError if code == ConfigError.exit_code else LinkError
        return kind(self._why(code))
