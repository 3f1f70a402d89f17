"""Questions and messages at the terminal, over a real pseudo-terminal."""

import os
import pty
import subprocess
import sys
import termios
import time
from pathlib import Path

from cartpole_rl.terminal import confirm

ASK = """
import sys
from cartpole_rl.terminal import confirm
print("ready", flush=True)
open(sys.argv[1]).read()  # waits until the test has typed ahead
print("agreed" if confirm("the cart latched a fault: STALL") else "not agreed", flush=True)
"""


def read_until(master: int, words: bytes) -> bytes:
    """Return the terminal output up to and including `words`."""
    seen, end = b"", time.monotonic() + 60
    while words not in seen:
        assert time.monotonic() < end, seen
        seen += os.read(master, 1000)
    return seen


def test_an_earlier_enter_does_not_answer_the_question(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    master, slave = pty.openpty()
    asking = subprocess.Popen([sys.executable, "-c", ASK, str(gate)], stdin=slave, stdout=slave, stderr=slave)
    try:
        read_until(master, b"ready")
        os.write(master, b"\n\n")
        gate.write_text("ready")
        shown = read_until(master, b"Ctrl-C to stop. ")
        assert b"the cart latched a fault: STALL." in shown
        assert asking.poll() is None
        os.write(master, b"\n")
        assert b"not agreed" not in read_until(master, b"agreed")
    finally:
        asking.kill()
        asking.wait()
        os.close(slave)
        os.close(master)


def test_without_a_terminal_no_question_is_asked() -> None:
    assert not confirm("the cart latched a fault")


WAIT = """
import time
from cartpole_rl.terminal import progress_bar, waiting
with waiting("homing"):
    time.sleep(1.2)
    with waiting(""):
        time.sleep(1.2)
with progress_bar(2, "episodes") as bar, waiting("driving"):
    time.sleep(1.2)
print("end", flush=True)
"""


def shown_by(script: str) -> str:
    """Run a script on a terminal of 100 columns; return what it shows, up to the "end" that it prints."""
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 100))
    with subprocess.Popen([sys.executable, "-c", script], stdin=slave, stdout=slave, stderr=slave):
        shown = read_until(master, b"end").decode()
    os.close(slave)
    os.close(master)
    return shown


def test_work_under_way_is_shown_with_its_seconds_and_a_bar_goes_on() -> None:
    shown = shown_by(WAIT)
    assert shown.count("homing, 1 s") == 1
    assert "homing, 2 s" not in shown  # the inner block shows nothing
    assert "driving" not in shown
    assert shown.count("0/2 [00:01") >= 1
    piped = subprocess.run([sys.executable, "-c", WAIT], capture_output=True, text=True, check=True)
    assert (piped.stdout, piped.stderr) == ("end\n", "")


BEAT = """
import time
from cartpole_rl.terminal import beat, progress_bar, waiting
def loop():
    end = time.monotonic() + 1.3
    while time.monotonic() < end:
        beat()
        time.sleep(0.02)
with waiting("driving", thread=False):
    loop()
    with progress_bar(2, "episodes"), waiting("bringing the cart to the middle", thread=False):
        loop()
    with progress_bar(2, "rounds"):
        loop()
print("end", flush=True)
"""


def test_a_loop_that_keeps_time_shows_that_it_goes_on_by_itself() -> None:
    shown = shown_by(BEAT)
    assert shown.count("driving, 1 s") == 1
    assert "bringing the cart to the middle:   0%" in shown
    assert shown.count("0/2 [") >= 6  # each bar: at its start, after a second, at its end


STOPPED = """
import sys, time
from cartpole_rl.terminal import beat, waiting
with waiting("driving", thread=False):
    while not sys.stdin.readline().startswith("go on"):
        pass
    end = time.monotonic() + 2.5
    while time.monotonic() < end:
        beat()
        time.sleep(0.02)
open(sys.argv[1], "w").write("ended")
"""


def test_a_terminal_that_takes_no_text_does_not_hold_up_a_loop(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    reader, writer = os.pipe()
    ended = tmp_path / "ended"
    with subprocess.Popen(
        [sys.executable, "-c", STOPPED, str(ended)], stdin=reader, stdout=slave, stderr=slave
    ) as process:
        termios.tcflow(slave, termios.TCOOFF)  # as Ctrl-S does
        os.write(writer, b"go on\n")
        assert process.wait(120) == 0
    assert ended.read_text() == "ended"
    for each in (master, slave, reader, writer):
        os.close(each)


OUTLIVED = """
from contextlib import ExitStack
from cartpole_rl.terminal import beat, waiting
outer, inner = ExitStack(), ExitStack()
outer.enter_context(waiting("driving", thread=False))
inner.enter_context(waiting("homing", thread=False))
outer.close()
beat()
inner.close()
print("in order", flush=True)
print("end", flush=True)
"""


def test_a_block_may_outlive_the_one_around_it() -> None:
    assert "in order" in shown_by(OUTLIVED)
