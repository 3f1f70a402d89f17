"""cartpole-distill makes an agent that the other commands take."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import yaml
from command_line import DISTILLATION, in_process, interrupt_after

from cartpole_rl.choices import choice
from cartpole_rl.learning.checkpoints import load_agent, save_agent
from cartpole_rl.workflows.build import trained_agent


def test_the_student_is_an_agent_like_any_other(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path / "teacher")
    checkpoint = tmp_path / "teacher/checkpoints/last.pt"
    save_agent(checkpoint, replace(load_agent(checkpoint), tuned_poles=[choice("pole/large")]))
    words = ("run=teacher", "hidden=[8,6]", *DISTILLATION, "hydra.run.dir=student")
    done = in_process("distill", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == "cartpole-export run=student format=c"
    student = tmp_path / "student"
    files = {"checkpoints", "config.yaml", "figures", "metrics.json", "provenance.json"}
    assert {path.name for path in student.iterdir()} == files
    assert json.loads((student / "provenance.json").read_text())["program"] == "cartpole-distill"
    assert trained_agent(student).known_poles == trained_agent(tmp_path / "teacher").known_poles
    teacher = yaml.safe_load((student / "config.yaml").read_text())["teacher"]
    assert teacher["program"] == "cartpole-train"
    assert teacher["transitions"] > 0
    done = in_process("export", "run=student", "format=c", "hydra.run.dir=c", folder=tmp_path)
    assert done.code == 0, done.err
    header = (tmp_path / "c/policy.h").read_text()
    assert "cartpole-distill run=" in header
    done = in_process("evaluate", "run=student", "episodes=1", "hydra.run.dir=e", folder=tmp_path)
    assert done.code == 0, done.err


def test_an_interrupted_one_says_what_to_do(trained: Path, tmp_path: Path) -> None:
    interrupt_after(tmp_path / "half/provenance.json")
    words = (f"run={trained}", "distillation.rounds=100000", "hydra.run.dir=half")
    done = in_process("distill", *words, folder=tmp_path)
    assert done.code == 130, done.err
    done = in_process("evaluate", "run=half", folder=tmp_path)
    assert done.complaint == (
        "cartpole-evaluate: run=half: this run of cartpole-distill has no agent yet; "
        "it was stopped before its end; start cartpole-distill again"
    )
