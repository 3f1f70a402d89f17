"""Stable-Baselines3 trains on the registered environments unchanged."""

import re
import sys

import pytest

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")

from examples.stable_baselines3_dqn import main


@pytest.mark.parametrize(("name", "least"), [("Balance", 1), ("SwingUp", -5)])  # 5 off for leaving the track
def test_the_example_trains_and_judges(
    name: str, least: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--env", f"cartpole_rl/{name}-v0", "--steps", "550", "--episodes", "1"]  # it learns after 500
    monkeypatch.setattr(sys, "argv", ["stable_baselines3_dqn.py", *words])
    main()
    score = re.search(r"^score (-?\d+) \+- 0 over 1 episodes$", capsys.readouterr().out, re.MULTILINE)
    assert score is not None
    assert least <= int(score[1]) <= 10_000
