"""Ranges without effect are found by simulation, for every cause."""

from typing import Any

import pytest
import torch

from cartpole_rl.choices import choice, conf_folder
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.effects import without_effect
from cartpole_rl.randomization.identified import IdentifiedCarts
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.rig.hardware import nominal_encoders

ACTIONS = sorted(path.stem for path in (conf_folder() / "actions").glob("*.yaml"))
RANDOMIZATIONS = sorted(path.stem for path in (conf_folder() / "randomization").glob("*.yaml"))
NARROW = {  # a per cent where nominal is not 0, and about as little where it is
    "backdrivability": (0.99, 1.0),
    "track_tilt": (0.0, 1e-4),
    "cart_coulomb_asymmetry": (0.0, 0.01),
    "pole_coulomb": (0.0, 1e-6),
    "force_quadratic": (0.0, 1e-8),
    "force_asymmetry": (0.0, 0.01),
    "deadband_left": (90.0, 110.0),
    "deadband_right": (90.0, 110.0),
    "motor_time_constant": (0.0, 1e-3),
    "latency_jitter": (0.0, 1e-4),
    "angle_offset": (0.0, 1e-4),
    "position_noise": (0.0, 1e-6),
    "angle_noise": (0.0, 1e-4),
    "coasting": (0.0, 0.01),
}


def ranges_of(name: str) -> dict[str, Range]:
    return {key: Range(**line) for key, line in choice(f"randomization/{name}").items()}


def idle(
    ip02: dict[str, float],
    ranges: dict[str, Range],
    poles: PoleSettings,
    actions: str = "nine_levels",
    models: Models = Models(),  # noqa: B008 - immutable
) -> set[str]:
    """Ranges without effect for an action set of conf/."""
    chosen: dict[str, Any] = choice(f"actions/{actions}")
    models = models._replace(actuator=ACTUATORS.find(chosen["actuator"]))
    carts, motors = Randomizer(ip02, poles, ranges), chosen["motors"]
    return set(without_effect(carts, ranges, motors, models, 0.02, nominal_encoders()))


@pytest.mark.parametrize(
    ("randomization", "actions"),
    [*((name, "nine_levels") for name in RANDOMIZATIONS), *(("wide", name) for name in ACTIONS)],
)
def test_every_shipped_range_has_an_effect(
    ip02: dict[str, float], medium: PoleSettings, both_poles: PoleSettings, randomization: str, actions: str
) -> None:
    """But for what plain newtons leave out by definition."""
    ranges = ranges_of(randomization)
    left_out = {"force_asymmetry", "motor_time_constant"} & set(ranges)
    others = (both_poles, PoleSettings(lengths=(0.2, 1.1))) if randomization == "wide" else ()
    for poles in (medium, *others):
        found = idle(ip02, ranges, poles, actions)
        assert found == (left_out if actions == "nine_newtons" else set())


@pytest.mark.parametrize("actions", [name for name in ACTIONS if name != "nine_newtons"])
def test_a_dead_band_below_the_smallest_motor_value_has_none(
    ip02: dict[str, float], medium: PoleSettings, actions: str
) -> None:
    names = ("deadband_left", "deadband_right")
    small = {**ranges_of("wide"), **{name: Range(absolute=(0.0, 60.0)) for name in names}}
    assert idle(ip02, small, medium, actions) == set(names)
    start = -ip02["force_offset"] / ip02["force_linear"]  # of the force
    smallest = min(motor for motor in choice(f"actions/{actions}")["motors"] if motor > start)
    large = {**small, **{name: Range(absolute=(0.0, smallest + 10.0)) for name in names}}
    assert idle(ip02, large, medium, actions) == set()


def test_narrow_ranges_have_an_effect(ip02: dict[str, float], medium: PoleSettings) -> None:
    """Of every parameter, by a per cent, under models that read all of them but the slope of the sigmoid."""
    models = Models.of(cart_friction="stribeck", pole_friction="bearing")
    names = [name for name in CartParameters.names() if name != "sigmoid_slope"]
    lines = {
        name: Range(absolute=NARROW[name]) if name in NARROW else Range(relative=(0.0, 0.01))
        for name in names
    }
    assert idle(ip02, lines, medium, models=models) == set()
    assert idle(ip02, {"sigmoid_slope": Range(relative=(0.0, 0.01))}, medium) == set()


def test_the_track_length_matters_only_at_its_end(ip02: dict[str, float], medium: PoleSettings) -> None:
    line = {"track_half_length": Range(absolute=(0.379, 0.38)), **ranges_of("friction_3")}
    assert idle(ip02, line, medium) == set()


def test_a_range_that_is_a_point_has_none(ip02: dict[str, float], medium: PoleSettings) -> None:
    assert idle(ip02, {"cart_mass": Range(absolute=(0.7, 0.7))}, medium) == {"cart_mass"}


def test_identified_carts_report_only_drawn_parameters(ip02: dict[str, float], medium: PoleSettings) -> None:
    """A range that no cart is drawn from has no effect."""
    ranges = {"cart_mass": Range(relative=(-0.2, 0.2)), "latency": Range(absolute=(0.0, 0.02))}
    others = Randomizer(ip02, medium, ranges)
    found = others.nominal.unsqueeze(1).repeat(1, 5)

    def unread(prior_share: float, identified: list[str] | None) -> list[str]:
        carts = IdentifiedCarts(found, others, prior_share, longest_latency=0.02, identified=identified)
        return without_effect(carts, ranges, (-200, 0, 200), Models(), 0.02, nominal_encoders())

    assert unread(0.0, None) == ["cart_mass", "latency"]
    assert unread(0.0, ["cart_mass"]) == ["cart_mass"]
    assert unread(0.001, None) == []


def test_the_search_does_not_change_the_random_state(ip02: dict[str, float], medium: PoleSettings) -> None:
    before = torch.get_rng_state()
    first, second = (idle(ip02, ranges_of("wide"), medium, "nine_newtons") for _ in range(2))
    assert first == second
    assert torch.equal(torch.get_rng_state(), before)
