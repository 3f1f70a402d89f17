"""A command's last lines say where its results are, by relative paths, and which command to run next."""

import io
import shlex
import sys
from pathlib import Path

import hydra
import pytest
from command_line import COARSE, Outcome, in_process

from cartpole_rl.command import wrapped
from cartpole_rl.composition import reading_conf
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.terminal import print_loop_time

pytestmark = pytest.mark.usefixtures("without_pictures")
SIMULATED = "cartpole-evaluate run=run plant=emulated"
EMULATED = "cartpole-finetune run=run plant=emulated emulator.physics_step=0.001"


def compose(command: str) -> None:
    """Compose the settings of a command line; Hydra raises an error for a wrong word."""
    program, *words = shlex.split(command)
    with reading_conf():
        hydra.compose(program.removeprefix("cartpole-"), words)


@pytest.mark.parametrize(
    ("words", "following"),
    [
        (("plant=simulated",), SIMULATED),
        (("plant=emulated", COARSE), EMULATED),
        (("pole=large",), f"{SIMULATED} emulator=large"),
    ],
)
def test_an_evaluation_leads_to_the_cart(words: tuple[str, ...], following: str, trained: Path) -> None:
    """And tells of another pole than the agent's."""
    name = f"last_{words[0].partition('=')[2]}"
    words = ("run=run", "episodes=1", *words, f"hydra.run.dir={name}")
    done = in_process("evaluate", *words, folder=trained.parent)
    *_, written, last = done.out.splitlines()
    assert written == f"{name}/metrics.json and figures/ are written; next:"
    assert last == following
    other = "the agent was trained with a pole of 0.36 m, the cart has one of 0.66 m" in done.err
    assert other == ("pole=large" in words)
    compose(last)


@pytest.mark.parametrize(
    ("plant", "following"),
    [
        (("plant=simulated",), "cartpole-evaluate run=last_pushes:push {} plant=emulated"),
        (("plant=emulated", COARSE), f"cartpole-record run=last_pushes:push {{}} plant=emulated {COARSE}"),
    ],
)
def test_an_own_policy_keeps_what_it_sees_and_does(
    plant: tuple[str, ...], following: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "last_pushes.py").write_text("push = lambda observation: observation[:, 0] > 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    told = ("observation=raw", "actions=three", "control_period=0.01")
    words = ("run=last_pushes:push", *told, "episodes=1", "task=swingup", "task.time_limit=5", *plant)
    done = in_process("evaluate", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1].replace("0.001", "1e-3") == following.format(" ".join(told))


def test_an_agent_on_another_pole_is_told_which_cart_has_its_own(tmp_path: Path) -> None:
    words = ("plant=emulated", COARSE, "task=swingup", "task.time_limit=5", "episodes=1")
    done = in_process("evaluate", "run=pretrained/large", *words, folder=tmp_path)
    assert "trained with a pole of 0.66 m, the cart has one of 0.35 m; give emulator=large" in done.err
    last = done.out.splitlines()[-1]
    assert last == "cartpole-identify plant=emulated emulator=large emulator.physics_step=0.001 pole=large"
    compose(last)


def test_a_fine_tuning_leads_to_an_evaluation_on_its_cart(tuned: tuple[Path, Outcome]) -> None:
    *_, written, last = tuned[1].out.splitlines()
    assert written.startswith("run/metrics.json, comparison.json, checkpoints/last.pt and recordings/ are")
    assert last == "cartpole-evaluate run=run plant=emulated emulator.physics_step=0.001"


def test_a_measured_loop_time_is_printed_with_what_it_lacks(capsys: pytest.CaptureFixture[str]) -> None:
    statistics = LinkStatistics()
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == ""
    statistics.loop_times.append(0.004)
    print_loop_time(statistics.latency_override())
    assert capsys.readouterr().out == (
        "measured loop time as an override of cartpole-train; add the latency that cartpole-preflight prints "
        "to both numbers: '++randomization.latency={distribution: uniform, absolute: [0.004, 0.004]}'\n"
    )


class Narrow(io.StringIO):
    """A terminal as standard output."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def test_choices_are_wrapped_in_a_narrow_terminal_and_nowhere_else(monkeypatch: pytest.MonkeyPatch) -> None:
    line = "  reward: constant, cosine, linear_angle, position, score, upright_bonus"
    assert wrapped(line) == line
    monkeypatch.setattr(sys, "stdout", Narrow())
    monkeypatch.setenv("COLUMNS", "50")
    assert wrapped(line).splitlines() == [
        "  reward: constant, cosine, linear_angle,",
        "    position, score, upright_bonus",
    ]
