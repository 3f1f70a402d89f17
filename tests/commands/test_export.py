"""cartpole-export writes the files of each format, and says which."""

import json
from pathlib import Path

import pytest
import torch
from command_line import in_process

from cartpole_rl.exporting.agent import read_agent

FILES = {
    "weights": {"agent.npz"},
    "onnx": {"agent.onnx"},
    "c": {"policy.h", "policy.c"},
    "web": {"cart.html"},
}


@pytest.mark.parametrize("form", FILES)
def test_it_writes_the_files_of_the_format(form: str, tmp_path: Path) -> None:
    if form == "onnx":
        pytest.importorskip("onnxscript", reason='onnxscript is missing: pip install "cartpole_rl[export]"')
    words = ("run=pretrained/medium", f"format={form}", "hydra.run.dir=run")
    done = in_process("export", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert done.err == ""
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == FILES[form] | {"config.yaml", "provenance.json"}
    assert all(f"run/{name}" in done.out for name in FILES[form])
    assert json.loads((tmp_path / "run/provenance.json").read_text())["program"] == "cartpole-export"


def test_an_agent_of_ones_own_is_exported_with_its_provenance(trained: Path, tmp_path: Path) -> None:
    run = trained / "checkpoints/best.pt"
    done = in_process("export", f"run={run}", "format=weights", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 0, done.err
    about = read_agent(tmp_path / "run/agent.npz").description
    assert len(about.motors) == 2
    assert about.provenance["command"][0] == "cartpole-train"


def test_a_refused_export_leaves_no_run(tmp_path: Path) -> None:
    checkpoint = torch.load("cartpole_rl/pretrained/medium/agent.pt", weights_only=True)
    checkpoint["config"]["plant"] = {"kind": "learned", "model": "model", "prior_share": 0.0}
    torch.save(checkpoint, tmp_path / "agent.pt")
    done = in_process("export", "run=agent.pt", "format=web", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 2
    assert "format=web: the agent was trained with plant=learned" in done.err
    assert not (tmp_path / "run/config.yaml").exists()
