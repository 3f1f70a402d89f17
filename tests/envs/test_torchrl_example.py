"""The script in docs/torchrl.md runs, with either loss, and changes the network."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = Path(__file__).parents[2] / "docs/torchrl.md"
SIZES = {
    "CARTS, PERIODS, TRANSITIONS = 64, 8, 500_000": "CARTS, PERIODS, TRANSITIONS = 8, 4, 640",
    "UPDATES, BATCH_SIZE, WARMUP = 8, 256, 5_000": "UPDATES, BATCH_SIZE, WARMUP = 2, 32, 160",
}


def replaced(text: str, old: str, new: str) -> str:
    """Return `text` with its only `old` replaced."""
    assert text.count(old) == 1, old
    return text.replace(old, new)


@pytest.mark.parametrize("advantage_learning", [False, True])
def test_the_script_trains(advantage_learning: bool, capsys: pytest.CaptureFixture[str]) -> None:
    script, other_loss = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for size, toy in SIZES.items():
        script = replaced(script, size, toy)
    if advantage_learning:
        stock = next(line for line in script.splitlines() if line.startswith("loss = DQNLoss("))
        script = replaced(script, stock, other_loss)
    names: dict[str, Any] = {}
    exec(compile(script, str(PAGE), "exec"), names)
    assert type(names["loss"]).__name__ == ("AdvantageLearningLoss" if advantage_learning else "DQNLoss")
    assert len(names["buffer"]) == 640
    assert names["explore"].eps.item() == pytest.approx(0.02)
    assert names["value"].isfinite()
    online, target = names["loss"].value_network_params, names["loss"].target_value_network_params
    gap = [(online[name] - target[name]).abs().max() for name in target.keys(True, True)]
    assert 0 < torch.stack(gap).max() < 1  # the target follows the network as it learns
    assert re.fullmatch(r"mean score \(6\.1\) of 20 episodes: \d+ of 500\n", capsys.readouterr().out)
