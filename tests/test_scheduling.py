"""The scheduling priority that the operating system reports, and imports without garbage collection."""

import gc
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from cartpole_rl.scheduling import ImportedFast

pytestmark = pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="Linux only")


def in_a_process(lines: str) -> str:
    imports = "import os, resource\nfrom cartpole_rl.scheduling import *"
    program = f"{imports}\n{lines}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_it_says_whether_it_has_priority() -> None:
    policy = os.SCHED_FIFO  # where it is allowed; the usual one stays where not
    said = in_a_process("print(take_precedence(), os.sched_getscheduler(0))")
    assert said in (f"True {policy}", f"False {os.SCHED_OTHER}")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can give up being root")
def test_without_permission_all_stays_as_it_was() -> None:
    give_up = "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0)); os.setuid(65534)"
    said = in_a_process(f"{give_up}; print(take_precedence(), os.sched_getscheduler(0))")
    assert said == f"False {os.SCHED_OTHER}"


def test_it_goes_last() -> None:
    lines = "with giving_precedence():\n    print(os.sched_getscheduler(0))\nprint(os.sched_getscheduler(0))"
    within, after = map(int, in_a_process(lines).split())
    assert within == os.SCHED_IDLE
    assert after == os.sched_getscheduler(0)


def test_what_it_inherited_is_lost() -> None:
    said = in_a_process("take_precedence(); lose_precedence(1); print(os.sched_getscheduler(0))")
    assert said == str(os.SCHED_OTHER)


def test_it_goes_first_for_a_while() -> None:
    lines = "with taking_precedence():\n    print(os.sched_getscheduler(0))\nprint(os.sched_getscheduler(0))"
    within, after = map(int, in_a_process(lines).split())
    assert within in (os.SCHED_FIFO, os.SCHED_OTHER)  # where it is allowed; the usual one stays where not
    assert after == os.sched_getscheduler(0)


def test_the_target_of_a_process_is_imported_without_garbage_collection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "slow_one.py").write_text("import gc\ncollects = gc.isenabled()\ndef target(): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    import slow_one

    sent = pickle.dumps(ImportedFast(slow_one.target))
    monkeypatch.delitem(sys.modules, "slow_one")
    target = pickle.loads(sent)
    assert (target.__name__, target.__globals__["collects"], gc.isenabled()) == ("target", False, True)
