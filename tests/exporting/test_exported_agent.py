"""An agent that cannot drive is refused; the provenance of its training may be missing or damaged."""

import copy
import shutil
from pathlib import Path

import pytest
import torch

from cartpole_rl.errors import CheckpointError
from cartpole_rl.workflows.agents import TrainedAgent
from cartpole_rl.workflows.export import exported_agent, provenance


def test_a_weight_that_is_not_finite_is_refused_for_every_format(medium_agent: TrainedAgent) -> None:
    broken = TrainedAgent(medium_agent.training, copy.deepcopy(medium_agent.policy))
    with torch.no_grad():
        next(broken.policy.parameters()).fill_(torch.nan)
    with pytest.raises(CheckpointError, match=r"run: layer0\.weight is not finite"):
        exported_agent(broken, {})


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"command": 1}', '{"command": [1]}', '{"command": "a"}', '{"seed": Infinity}', "\xff"],
)
def test_a_damaged_provenance_is_left_out(text: str, medium_agent: TrainedAgent, tmp_path: Path) -> None:
    shutil.copy("cartpole_rl/pretrained/medium/agent.pt", tmp_path)
    (tmp_path / "provenance.json").write_text(text, encoding="latin-1")
    agent = exported_agent(medium_agent, provenance(tmp_path / "agent.pt"))
    assert agent.description.origin == "unknown"
    assert len(agent.checksum) == 64
