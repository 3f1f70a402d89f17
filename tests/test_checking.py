"""A message about a wrong setting names the key as it is written on the command line."""

from typing import Any

import pytest

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.config import EvaluateConfig, TrainConfig

PLANTS = {
    "simulated": {"substeps": 0},
    "learned": {"model": "model.pt", "prior_share": 2},
    "emulated": {"rehome": "never"},
    "serial": {"port": "/dev/ttyUSB0", "timeout": 0},
}
IDENTIFIED = {"posterior": "posterior.npz", "widen": 1.0, "prior_share": 0.1, "ranges": {}}


@pytest.mark.parametrize("kind", PLANTS)
def test_the_kind_of_a_plant_is_no_part_of_a_key(kind: str) -> None:
    values = compose("evaluate", {"plant": {"kind": kind, **PLANTS[kind]}, "run": "lqr"})
    *_, wrong = PLANTS[kind]
    with pytest.raises(ConfigError, match=rf"(^|; )plant\.{wrong}="):
        validated(EvaluateConfig, values)


@pytest.mark.parametrize(
    ("randomization", "message"),
    [
        ({"cart_mass": {"spread": 1}}, r"randomization\.cart_mass: spread: there is no such setting"),
        ({**IDENTIFIED, "widen": -1}, r"randomization\.widen=-1: "),
        (
            {**IDENTIFIED, "ranges": {"latency": 1}},
            r"randomization\.ranges\.latency=1: give a mapping, as \{name:value\}",
        ),
    ],
)
def test_the_kind_of_a_randomization_is_no_part_of_a_key(randomization: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=rf"(^|; ){message}"):
        validated(TrainConfig, {**compose("train"), "randomization": randomization})
