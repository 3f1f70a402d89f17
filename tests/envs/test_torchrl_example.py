"""The script in docs/torchrl.md runs, with either loss, and changes the network."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = Path(__file__).parents[2] / "docs/torchrl.md"
SIZES = {
    "COMPILED = True": "COMPILED = False",
    "CARTS, PERIODS, ITERATIONS = 1024, 8, 488": "CARTS, PERIODS, ITERATIONS = 8, 8, 10",
    "WARMUP, BUFFER = 64, 512, 20_000, 1_000_000": "WARMUP, BUFFER = 2, 32, 160, 2_000",
}


def replaced(text: str, old: str, new: str) -> str:
    """Return `text` with its only `old` replaced."""
    assert text.count(old) == 1, old
    return text.replace(old, new)


@pytest.mark.parametrize("advantage_learning", [True, False])
def test_the_script_trains(advantage_learning: bool, capsys: pytest.CaptureFixture[str]) -> None:
    script, other_loss = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(script.splitlines()) <= 80
    for size, toy in SIZES.items():
        script = replaced(script, size, toy)
    if not advantage_learning:
        own = re.findall(r"^loss = AdvantageLearningLoss\(.*?^\)\n", script, re.DOTALL | re.MULTILINE)
        script = replaced(script, own[0], other_loss)
    names: dict[str, Any] = {}
    exec(compile(script, str(PAGE), "exec"), names)
    assert type(names["loss"]).__name__ == ("AdvantageLearningLoss" if advantage_learning else "DQNLoss")
    assert len(names["buffer"]) == 8 * (10 * 8 - 5)  # the last five periods wait for their returns
    assert names["explore"].eps.item() == pytest.approx(0.5 - 0.48 * (640 - 160) / 500_000)
    assert names["value"].isfinite()
    online, target = names["loss"].value_network_params, names["loss"].target_value_network_params
    gap = [(online[name] - target[name]).abs().max() for name in target.keys(True, True)]
    assert 0 < torch.stack(gap).max() < 1  # the target follows the network as it learns
    assert re.fullmatch(r"mean score \(6\.2\) of 20 episodes: -?\d+ of 5500\n", capsys.readouterr().out)
