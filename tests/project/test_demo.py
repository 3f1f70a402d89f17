"""The comparison that scripts/demo.py draws shows all episodes."""

import runpy
from pathlib import Path

from figure_contents import words

DEMO = Path(__file__).parents[2] / "scripts/demo.py"


def result(scores: list[float], low: float, high: float) -> dict:
    mean = {"mean": sum(scores) / len(scores), "low": low, "high": high}
    return {"score": mean, "episodes": [{"score": each} for each in scores]}


RESULTS = {
    "simulated": result([4000.0, 4100.0, 4200.0], 4080.0, 4120.0),
    "emulated": result([3000.0, 3200.0], 3050.0, 3150.0),
}


def test_labels_have_interval_and_ratio() -> None:
    text = words(runpy.run_path(str(DEMO))["comparison"](RESULTS))
    assert "4100 ± 20" in text
    assert "0.76 × simulated" in text
    assert "2 episodes" in text
