"""The live view fits every terminal, says what the cart does, and gives the terminal back."""

import os
import pty
import signal
import sys
import termios
import threading
import time
from typing import Self

import pytest

from cartpole_rl.evaluation.snapshots import Snapshot, write
from cartpole_rl.reporting.live_view import ALL_LINES, GREEN, LiveView, view

CALM = Snapshot(2, 120, -100, 0, 0, 1, 0.19, -0.25, 0.01, 0.5, 812.4, 0.38, 0.34)


def test_it_shows_every_number() -> None:
    text = "\n".join(view("cart on /dev/ttyUSB0", CALM, fresh=True, width=80, colour=False))
    for words in (
        "cart on /dev/ttyUSB0: episode 2, step 120",
        "+19.0 cm  -0.25 m/s",
        "+0.6 deg  +0.50 rad/s",
        "-100",
        "812",
        "track guard off",
        "late ticks 0   lost frames 1",
    ):
        assert words in text


def test_marks_are_where_the_cart_is() -> None:
    _, cart, pole, motor, *_ = view("", CALM, fresh=True, width=80, colour=False)
    bars = [line[line.index("[") + 1 : line.index("]")] for line in (cart, pole, motor)]
    half = len(bars[0]) // 2
    assert [bar.index("#") - half for bar in bars] == [round(0.5 * half), 0, round(-100 / 255 * half)]


def test_an_old_snapshot_is_of_an_episode_that_has_ended() -> None:
    assert "episode 2, ended at step 120" in view("", CALM, fresh=False, width=80, colour=False)[0]
    assert "waiting for the cart" in view("", None, fresh=False, width=80, colour=False)[1]


class Terminal:
    """A pseudo-terminal as the standard error of this process, and of those that it starts, in a `with`."""

    def __init__(self) -> None:
        self.text = ""
        self._reader, writer = pty.openpty()
        termios.tcsetwinsize(writer, (40, 61))
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
            write(live.memory, 1, CALM)
            terminal.wait_for("emulated cart: episode 2, step 120")
            assert ALL_LINES not in terminal.text
            assert "\x1b[8;40r" in terminal.text  # of this terminal; stdout is another file
            os.kill(live._process.pid, signal.SIGSTOP)  # it is ended, too
        terminal.wait_for(ALL_LINES)
    assert GREEN not in terminal.text


@pytest.mark.parametrize("term", ["", "dumb"])
def test_no_view_where_the_cursor_cannot_move(term: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", term)
    with Terminal() as terminal, LiveView("emulated cart", "live") as live:
        assert live.memory is None
        terminal.wait_for("view=live needs a terminal")


@pytest.mark.parametrize(
    ("chosen", "told"),
    [("none", ""), ("live", "view=live needs a terminal; the cart is driven without it\n")],
)
def test_no_view_in_a_pipe_or_unless_it_is_chosen(
    chosen: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with LiveView("emulated cart", chosen) as live:
        assert live.memory is None
    assert capsys.readouterr().err == told
