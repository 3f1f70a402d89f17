"""cartpole-evaluate with the agent on the cart's board, beside this computer."""

import json
from pathlib import Path

import pytest
from command_line import COARSE, in_process
from firmwares import needs_compiler

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated import EmulatedCart

SHUTTLE = Path(__file__).parents[1] / "support" / "shuttle"
SERIAL = ("plant=serial", "plant.port=x", "plant.policy=onboard")
BOARD = ("plant=emulated", "emulator.firmware=c", "emulator.policy=onboard")


@needs_compiler
def test_the_scores_stand_side_by_side(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    words = (f"run={trained}", *BOARD, COARSE, "episodes=1", "hydra.run.dir=run")
    done = in_process("evaluate", *words, folder=tmp_path)
    assert done.code == 0, done.err
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    (episode,) = metrics["onboard"]["episodes"]
    assert episode["same_as_host_fraction"] == metrics["onboard"]["same_as_host_fraction"]["mean"] > 0.9
    assert "same_as_host_fraction" not in metrics["episodes"][0]
    heading = done.out.splitlines()[0]
    assert "this computer" in heading
    assert "on the board" in heading
    assert "motor values are those that this computer would have sent" in done.out
    for name in ("behaviour.png", "episode.gif"):
        assert (tmp_path / "run/figures" / name).is_file()
        assert (tmp_path / "run/figures" / f"onboard_{name}").is_file()
    assert "emulator:" in (tmp_path / "run/config.yaml").read_text()
    assert "policy: onboard" in (tmp_path / "run/config.yaml").read_text()


@needs_compiler
@pytest.mark.parametrize(
    ("policy", "complaint"),
    [
        (None, "the cart's board has no policy: compile its firmware with one"),
        (SHUTTLE, "the cart's board has another agent (00000005, not "),
    ],
    ids=["no policy", "another agent"],
)
def test_a_board_without_the_agent_is_refused_before_it_moves(
    policy: Path | None, complaint: str, trained: Path, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    journal = tmp_path / "journal"
    truth = EmulatorSettings(firmware="c", policy=policy, physics_step=1e-3, journal=journal)
    with EmulatedCart(truth) as cart:
        words = (
            f"run={trained}",
            SERIAL[0],
            f"plant.port={cart.port}",
            SERIAL[2],
            "episodes=2",
            "plant.clear_faults=9",
        )
        done = in_process("evaluate", *words, "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 1
    assert complaint in done.complaint
    assert not (tmp_path / "run/metrics.json").exists()
    assert "in_force" not in journal.read_text()


@pytest.mark.parametrize(
    ("command", "words", "named", "remedy"),
    [
        ("evaluate", (*BOARD, "run=lqr"), "run=lqr", "give its run folder"),
        ("evaluate", ("plant=emulated", "emulator.policy=onboard"), "emulator", "set firmware=c"),
        (
            "evaluate",
            (*BOARD[:2], "emulator.policy=out"),
            "emulator.policy=out",
            "give emulator.policy=onboard",
        ),
        ("record", BOARD, "emulator.policy=onboard", "leave it out"),
        ("finetune", BOARD, "emulator.policy=onboard", "leave it out"),
        ("preflight", SERIAL, "plant.policy", "leave it out"),
        ("evaluate", (*BOARD, "repeat.run=x", "repeat.episode=0"), "repeat", "leave out repeat.*"),
        ("evaluate", (*SERIAL, "guard=none"), "guard", "leave out guard"),
        (
            "evaluate",
            (*SERIAL, "++actions={motors: [-100, 100], actuator: force_curve}"),
            "actions",
            "leave out actions",
        ),
        ("evaluate", (*SERIAL, "task=balance"), "task", "leave out task"),
        ("emulate", BOARD[1:], "emulator.policy=onboard", "give a folder of cartpole-export format=c"),
    ],
)
def test_bad_input_is_answered_with_one_line(
    command: str, words: tuple[str, ...], named: str, remedy: str, trained: Path, tmp_path: Path
) -> None:
    run = () if command in ("preflight", "emulate") or "run=lqr" in words else (f"run={trained}",)
    done = in_process(command, *run, *words, folder=tmp_path)
    assert done.code in (1, 2)
    assert named in done.complaint
    assert remedy in done.complaint
    assert not (tmp_path / "runs").exists()
