"""The page and the table of an identification show what they were given."""

import dataclasses

import numpy as np
import torch

from cartpole_rl.identification.fit import Fit
from cartpole_rl.identification.identify import Candidate, Identification, PredictionError
from cartpole_rl.identification.quantities import Quantity
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.reporting.identification import CAPTIONS, identification_page, quantities_table
from cartpole_rl.tasks.episode import Episode

QUANTITIES = [
    Quantity("latency", "latency", "ms", 12.0, 11.0, 13.0, 5.0),
    Quantity("viscous", "viscous friction", "1/s", 1.2, 1.1, 1.3, 0.6),
]
FIT = Fit([], np.empty(0), np.empty((0, 0)), {}, np.ones(2), np.zeros(2), 1.0, 1)


def candidate(friction: Law, x: float, theta: float) -> Candidate:
    dynamics = Dynamics(torch.empty(0, 1), Models(cart_friction=friction), 0.02, 4)
    return Candidate(FIT, dynamics, PredictionError(x, theta))


def found(warnings: list[str]) -> Identification:
    best = candidate(CART_FRICTIONS.find("step"), 1e-3, 0.01)
    candidates = [best, candidate(CART_FRICTIONS.find("linear"), 2e-3, 0.02)]
    return Identification(FIT, best.dynamics, candidates, [], best.error, warnings)


def test_the_table_has_values_with_intervals_and_units() -> None:
    rows = [line.split("  ") for line in quantities_table(QUANTITIES).splitlines()[2:]]
    assert [[cell.strip() for cell in row if cell] for row in rows] == [
        ["latency", "12.0 ± 1.0", "ms"],
        ["viscous friction", "1.20 ± 0.10", "1/s"],
    ]


def test_the_page_shows_all_results(swing_up: Episode) -> None:
    odd = dataclasses.replace(swing_up, ended_by="<fault>")
    recordings = {"ramps": swing_up, "<my> recording": odd}
    text = identification_page(found(["check a"]), QUANTITIES, recordings, "train x=1")
    for part in ("ramps", "where the cart breaks away", "&lt;my&gt; recording", "&lt;fault&gt;"):
        assert part in text
    for part in ("12.0 ± 1.0 ms", "0.600 1/s", "2.00", "check a", "train x=1"):
        assert part in text
    assert "1.00 mm and 0.57 deg" in text
    for name, caption in CAPTIONS.items():
        assert f'src="figures/{name}.png" alt="{caption}"' in text


def test_without_warnings_it_says_so() -> None:
    text = identification_page(found([]), QUANTITIES, {}, "train")
    assert "<h2>Warnings</h2>\n<ul><li>None.</li></ul>" in text
