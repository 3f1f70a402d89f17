"""The benchmark of distillation states what an agent costs on a processor."""

from pathlib import Path

import distillation
import pytest

from cartpole_rl.workflows.agents import trained_agent


def test_the_costs_are_those_of_the_exported_code() -> None:
    found = distillation.costs(trained_agent(Path("pretrained/medium")))
    assert found == {"hidden": "128, 64", "table bytes": 42_554, "multiply-adds": 10_048}


def test_sizes_are_units_of_each_layer() -> None:
    assert distillation.sizes("32,16") == (32, 16)
    with pytest.raises(ValueError, match="x"):
        distillation.sizes("x")
