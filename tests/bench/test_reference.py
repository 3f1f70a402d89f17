"""The search for reference scores: it reports what the environment counts; more work finds no less."""

import importlib.util
import itertools
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

BENCH = Path(__file__).parents[2] / "scripts" / "bench"
STEPS, GENERATIONS = 110, 8


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference_script", BENCH / "reference.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and named tuples look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def config(reference: ModuleType) -> Any:
    return reference.composed([f"task.time_limit={STEPS}"])


@pytest.fixture(scope="module")
def cart(reference: ModuleType, config: Any) -> Any:
    return reference.KnownCart(config)


@pytest.fixture(scope="module")
def found(reference: ModuleType, cart: Any) -> list[int]:
    return reference.search(cart, 0.05, 120, GENERATIONS)


def test_the_environment_counts_what_the_search_counted(
    reference: ModuleType, config: Any, cart: Any, found: list[int]
) -> None:
    played = reference.replay(config, 0.05, found)
    points = cart.run(cart.hanging(0.05), found).points
    assert len(played.points) == len(found) == STEPS
    assert sum(played.points) == pytest.approx(float(points), abs=0.01)


def test_it_brings_the_pole_up_and_holds_it(reference: ModuleType, config: Any, found: list[int]) -> None:
    played = reference.replay(config, 0.05, found)
    assert all(abs(theta) < UPRIGHT_ANGLE for theta in played.theta[-10:])
    assert min(played.points[-10:]) > 5


def test_states_among_many_are_scored_as_alone(cart: Any) -> None:
    nodes = cart.hanging(0.0)
    actions = torch.arange(len(cart.motors))
    together, points, _ = cart.step(nodes.at(torch.zeros_like(actions)), actions)
    for action in actions:
        alone, alone_points, _ = cart.step(nodes, action.unsqueeze(0))
        assert float(alone_points) == pytest.approx(float(points[action]), abs=1e-6)
        assert torch.equal(alone.counts[:, 0], together.counts[:, action])


def test_leaving_the_track_ends_what_is_counted(reference: ModuleType, config: Any, cart: Any) -> None:
    rightward = [len(cart.motors) - 1] * STEPS
    played = reference.replay(config, 0.1, rightward)
    assert len(played.points) < STEPS
    assert sum(played.points) == pytest.approx(float(cart.run(cart.hanging(0.1), rightward).points), abs=0.01)


def test_a_wider_search_contains_the_narrower_ones(reference: ModuleType) -> None:
    narrow, wide = list(reference.rungs(1000)), list(reference.rungs(5000))
    assert wide[: len(narrow)] == narrow
    assert wide[-1] == 5000


def test_more_states_do_not_find_less(
    reference: ModuleType, config: Any, cart: Any, found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference, "FIRST_RUNG", 120)
    more = reference.search(cart, 0.05, 130, GENERATIONS)
    scores = [sum(reference.replay(config, 0.05, actions).points) for actions in (found, more)]
    assert scores[1] >= scores[0] - 0.01


def test_pushes_give_the_mean_force_of_each_step(reference: ModuleType, cart: Any) -> None:
    pushes = torch.zeros(1, reference.PUSHES)
    pushes[0, :3] = torch.tensor([2.5, 0.25, 1.25])  # right, left, right
    forces = cart.forces[reference.pushed(cart, pushes, 5)[0]]
    assert forces.tolist() == pytest.approx([4, 4, 2, 4, 0])


def test_a_state_that_stands_in_the_middle_lacks_nothing(reference: ModuleType, cart: Any) -> None:
    zero = torch.zeros(1)
    standing = reference.State(zero, zero, zero, zero)
    assert float(reference.lacking(cart, standing)) == 0
    for change in ({"x": zero + 0.1}, {"x_dot": zero + 0.5}, {"theta": zero - 0.2}, {"theta_dot": zero + 2}):
        assert float(reference.lacking(cart, standing._replace(**change))) > 1


def test_only_a_cart_that_is_alike_to_both_sides_is_mirrored(reference: ModuleType, cart: Any) -> None:
    assert cart.symmetric
    for change in ("cart.force_asymmetry=0.1", "cart.track_tilt=0.01", "cart.deadband_left=20"):
        assert not reference.KnownCart(reference.composed([change])).symmetric
    assert not reference.KnownCart(
        reference.composed(["actions.motors=[-250,0,200]", "agent.mirrored=false"])
    ).symmetric


def test_references_are_of_both_poles_and_better_than_the_thesis_asks() -> None:
    known = json.loads((BENCH / "references.json").read_text())
    assert {"medium", "large"} <= set(known)
    for plant in known.values():
        scores = [start["score"] for start in plant["starts"].values()]
        assert plant["score"] == pytest.approx(sum(scores) / len(scores), abs=0.1)
        assert min(scores) > 2500
    rods = [known[name]["score"] for name in sorted(set(known) - {"medium", "large"})]
    assert all(short > long for short, long in itertools.pairwise(rods))
