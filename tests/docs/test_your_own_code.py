"""Every recipe of docs/your-own-code.md runs, in the order of the page, in at most 30 lines."""

import re
import sys
from pathlib import Path
from typing import Any

import pytest
from torchrl.objectives import DQNLoss
from toy_settings import run_block, work_in

from cartpole_rl.workflows.build import network_of, new_agent, trained_agent

PAGE = Path(__file__).parents[2] / "docs/your-own-code.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)
PRINTED = re.compile(r"^ *print\(.*\)  # (.*)$", re.M)


@pytest.mark.nightly  # test_commands.py reads the blocks in every run
@pytest.mark.usefixtures("without_pictures", "own_extensions")
def test_every_recipe_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_in(tmp_path, monkeypatch)
    monkeypatch.setattr(sys, "path", [*sys.path])
    names: dict[str, Any] = {"__name__": "notebook"}
    for block in BLOCKS:
        assert block.count("\n") <= 30, block
        if file := re.match(r"# (my_\w+\.py)\n", block):
            monkeypatch.delitem(sys.modules, Path(file[1]).stem, raising=False)
            Path(file[1]).write_text(block, encoding="utf-8")
            continue
        output = run_block(block, PAGE, names)
        for expected in PRINTED.findall(block):
            assert expected in output.splitlines()
    assert "['against', 'network', 'stock'] 6 episodes failed" in output
    agent = trained_agent(Path("runs/train/stock"))
    assert network_of(agent).plain_layers()  # it can be exported
    assert type(new_agent(agent.training).loss) is DQNLoss
    lines = Path("runs/train/light/curves.txt").read_text()
    assert " learning/loss " in lines
