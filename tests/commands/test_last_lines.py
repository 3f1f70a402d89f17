"""A command's last lines say where its results are, by relative paths, and which command to run next."""

import io
import os
import pty
import shlex
import sys
import termios
from pathlib import Path

import hydra
import pytest
from command_line import COARSE, Outcome, in_process
from hydra_configs import shipped_choices

from cartpole_rl.command import wrapped
from cartpole_rl.terminal import progress_bar

pytestmark = pytest.mark.usefixtures("without_pictures")
SIMULATED = "cartpole-evaluate run=run plant=emulated"
EMULATED = "cartpole-finetune run=run plant=emulated emulator.physics_step=0.001"


def compose(command: str) -> None:
    """Compose the settings of a command line; Hydra raises an error for a wrong word."""
    program, *words = shlex.split(command)
    with shipped_choices():
        hydra.compose(program.removeprefix("cartpole-"), words)


@pytest.mark.parametrize(
    ("words", "following"),
    [(("plant=simulated",), SIMULATED), (("plant=emulated", COARSE), EMULATED)],
)
def test_an_evaluation_leads_to_the_cart(words: tuple[str, ...], following: str, trained: Path) -> None:
    name = f"last_{words[0].partition('=')[2]}"
    words = ("run=run", "episodes=1", *words, f"hydra.run.dir={name}")
    done = in_process("evaluate", *words, folder=trained.parent)
    *_, written, last = done.out.splitlines()
    assert written == f"{name}/metrics.json and figures/ are written; next:"
    assert last == following
    compose(last)


def test_an_agent_on_another_pole_is_told_which_cart_has_its_own(tmp_path: Path) -> None:
    words = ("plant=emulated", COARSE, "task=swingup", "task.time_limit=5", "episodes=1")
    done = in_process("evaluate", "run=pretrained/large", *words, folder=tmp_path)
    assert "trained with a pole of 0.66 m, the cart has one of 0.35 m; give emulator=large" in done.err
    last = done.out.splitlines()[-1]
    assert last == "cartpole-identify plant=emulated emulator=large emulator.physics_step=0.001 pole=large"
    compose(last)


def test_a_chosen_pole_is_kept(trained: Path) -> None:
    done = in_process("evaluate", "run=run", "episodes=1", "pole=large", folder=trained.parent)
    assert "the agent was trained with a pole of 0.36 m, the cart has one of 0.66 m" in done.err
    assert done.out.splitlines()[-1] == "cartpole-evaluate run=run plant=emulated emulator=large"


def test_recordings_lead_to_a_replay_and_to_a_model(trained: Path) -> None:
    words = ("run=run", "episodes=2", "hydra.run.dir=last_record")
    *_, last = in_process("record", *words, folder=trained.parent).out.splitlines()
    assert last == "cartpole-replay from=last_record"
    compose(last)
    words = (*shlex.split(last)[1:], "hydra.run.dir=last_replay")
    replayed = in_process("replay", *words, folder=trained.parent)
    *_, written, last = replayed.out.splitlines()
    assert written == "last_replay/replay.json and figures/replay.png are written; next:"
    assert last == "cartpole-model from=last_record"
    compose(last)


def test_a_fine_tuning_leads_to_an_evaluation_on_its_cart(tuned: tuple[Path, Outcome]) -> None:
    *_, written, last = tuned[1].out.splitlines()
    assert written.startswith("run/metrics.json, comparison.json, checkpoints/last.pt and recordings/ are")
    assert last == "cartpole-evaluate run=run plant=emulated emulator.physics_step=0.001"


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


def test_a_progress_bar_is_drawn_on_a_terminal_and_nowhere_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    progress_bar(3, "episodes").update()
    assert capsys.readouterr().err == ""
    reader, writer = pty.openpty()
    termios.tcsetwinsize(writer, (24, 80))
    with os.fdopen(writer, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with progress_bar(3, "episodes") as bar:
            bar.update()
        shown = ""
        while "1/3" not in shown:  # the time limit of the test ends the wait otherwise
            shown += os.read(reader, 65536).decode()
