"""The live view in a terminal, and what happens without one."""

import os
import pty
import sys
import threading
import time
from typing import Self

import pytest

from cartpole_rl.evaluation.snapshots import Snapshot, write
from cartpole_rl.reporting.live_view import GREEN
from cartpole_rl.workflows.live import ALL_LINES, LiveView

SNAPSHOT = Snapshot(1, 7, 100, 0, 0, 0, 0.1, 0.0, 0.0, 0.0, 42.0, 0.38)


class Terminal:
    """A pseudo-terminal as the standard error of this process, and of those that it starts, in a `with`."""

    def __init__(self) -> None:
        self.text = ""
        self._reader, writer = pty.openpty()
        self._stderr = os.fdopen(writer, "w")

    def __enter__(self) -> Self:
        self._former, self._descriptor = sys.stderr, os.dup(2)
        os.dup2(self._stderr.fileno(), 2)
        sys.stderr = self._stderr
        threading.Thread(target=self._read, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        sys.stderr = self._former
        os.dup2(self._descriptor, 2)
        os.close(self._descriptor)

    def _read(self) -> None:
        while True:
            self.text += os.read(self._reader, 65536).decode()

    def wait_for(self, words: str) -> None:
        """Return once `words` are written; the time limit of the test ends the wait otherwise."""
        while words not in self.text:
            time.sleep(0.05)


def test_it_is_drawn_while_the_cart_is_driven_and_gives_the_terminal_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "1")
    with Terminal() as terminal:
        with LiveView("emulated cart", "live") as live:
            assert live.memory is not None
            terminal.wait_for("waiting for the cart")
            write(live.memory, 1, SNAPSHOT)
            terminal.wait_for("emulated cart: episode 1, step 7")
            terminal.wait_for("score  42")
            assert ALL_LINES not in terminal.text
        terminal.wait_for(ALL_LINES)
    assert GREEN not in terminal.text


@pytest.mark.parametrize("term", ["", "dumb"])
def test_no_view_where_the_cursor_cannot_move(term: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", term)
    with Terminal() as terminal, LiveView("emulated cart", "live") as live:
        assert live.memory is None
        terminal.wait_for("view=live needs a terminal")


def test_no_view_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    with LiveView("emulated cart", "live") as live:
        assert live.memory is None
    assert capsys.readouterr().err == "view=live needs a terminal; the cart is driven without it\n"


def test_nothing_happens_unless_it_is_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    with LiveView("emulated cart", "none") as live:
        assert live.memory is None
    assert capsys.readouterr().err == ""
