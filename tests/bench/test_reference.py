"""The search for reference scores: it reports what the environment counts; more work finds no less."""

import itertools
import json
from typing import Any

import pytest
import reference
import torch
from best_score.cart import KnownCart
from best_score.swing_up import PUSHES, lacking, pushed
from common import REFERENCES
from truths import REPORTED, draw_truths

from cartpole_rl.physics.dynamics import State
from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

STEPS, GENERATIONS = 110, 8


@pytest.fixture(scope="module")
def config() -> Any:
    return reference.composed([f"task.time_limit={STEPS}"])


@pytest.fixture(scope="module")
def cart(config: Any) -> KnownCart:
    return KnownCart(config)


@pytest.fixture(scope="module")
def found(cart: KnownCart) -> list[int]:
    return reference.search(cart, 0.05, 120, GENERATIONS)


def test_the_environment_counts_what_the_search_counted(
    config: Any, cart: KnownCart, found: list[int]
) -> None:
    played = reference.replay(config, 0.05, found)
    points = cart.run(cart.hanging(0.05), found).points
    assert len(played.points) == len(found) == STEPS
    assert sum(played.points) == pytest.approx(float(points), abs=0.01)


def test_it_brings_the_pole_up_and_holds_it(config: Any, found: list[int]) -> None:
    played = reference.replay(config, 0.05, found)
    assert all(abs(theta) < UPRIGHT_ANGLE for theta in played.theta[-10:])
    assert min(played.points[-10:]) > 5


def test_states_among_many_are_scored_as_alone(cart: KnownCart) -> None:
    nodes = cart.hanging(0.0)
    actions = torch.arange(len(cart.motors))
    together, points, _ = cart.step(nodes.at(torch.zeros_like(actions)), actions)
    for action in actions:
        alone, alone_points, _ = cart.step(nodes, action.unsqueeze(0))
        assert float(alone_points) == pytest.approx(float(points[action]), abs=1e-6)
        assert torch.equal(alone.counts[:, 0], together.counts[:, action])


def test_leaving_the_track_ends_the_score(config: Any, cart: KnownCart) -> None:
    rightward = [len(cart.motors) - 1] * STEPS
    played = reference.replay(config, 0.1, rightward)
    assert len(played.points) < STEPS
    assert sum(played.points) == pytest.approx(float(cart.run(cart.hanging(0.1), rightward).points), abs=0.01)


def test_a_wider_search_contains_the_narrower_ones() -> None:
    narrow, wide = list(reference.rungs(1000)), list(reference.rungs(5000))
    assert wide[: len(narrow)] == narrow
    assert wide[-1] == 5000


def test_more_states_do_not_find_less(
    config: Any, cart: KnownCart, found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference, "FIRST_RUNG", 120)
    more = reference.search(cart, 0.05, 130, GENERATIONS)
    scores = [sum(reference.replay(config, 0.05, actions).points) for actions in (found, more)]
    assert scores[1] >= scores[0] - 0.01


def test_pushes_give_the_mean_force_of_each_step(cart: KnownCart) -> None:
    pushes = torch.zeros(1, PUSHES)
    pushes[0, :3] = torch.tensor([2.5, 0.25, 1.25])  # right, left, right
    forces = cart.forces[pushed(cart, pushes, 5)[0]]
    assert forces.tolist() == pytest.approx([4, 4, 2, 4, 0])


def test_a_state_upright_in_the_middle_has_no_shortfall(cart: KnownCart) -> None:
    zero = torch.zeros(1)
    standing = State(zero, zero, zero, zero)
    assert float(lacking(cart, standing)) == 0
    for change in ({"x": zero + 0.1}, {"x_dot": zero + 0.5}, {"theta": zero - 0.2}, {"theta_dot": zero + 2}):
        assert float(lacking(cart, standing._replace(**change))) > 1


def test_only_a_symmetric_cart_is_mirrored(cart: KnownCart) -> None:
    assert cart.symmetric
    for change in ("cart.force_asymmetry=0.1", "cart.track_tilt=0.01", "cart.deadband_left=20"):
        assert not KnownCart(reference.composed([change])).symmetric
    assert not KnownCart(
        reference.composed(["actions.motors=[-250,0,200]", "agent.mirrored=false"])
    ).symmetric


def test_the_cart_of_a_truth_is_searched_and_replayed_with_its_numbers() -> None:
    (truth,) = draw_truths(REPORTED, 1)
    config = reference.truth_config(truth)
    cart = KnownCart(config)
    assert not cart.symmetric
    assert float(cart.one.cart_mass) == pytest.approx(truth["cart_mass"])
    assert float(cart.one.latency) == pytest.approx(truth["latency"])
    coulomb = cart.one.cart_coulomb * (1 + cart.one.cart_coulomb_asymmetry)
    assert float(coulomb) == pytest.approx(truth["cart_coulomb_right"])
    actions = [8] * 6 + [0] * 12 + [8] * 4
    points = cart.run(cart.hanging(0.0), actions).points
    assert sum(reference.replay(config, 0.0, actions).points) == pytest.approx(float(points), abs=1e-4)


def test_references_are_of_both_poles_and_better_than_the_thesis_asks() -> None:
    known = json.loads(REFERENCES.read_text())
    assert {"medium", "large"} <= set(known)
    for plant in known.values():
        scores = [start["score"] for start in plant["starts"].values()]
        assert plant["score"] == pytest.approx(sum(scores) / len(scores), abs=0.1)
        assert min(scores) > 2500
    rods = [known[name]["score"] for name in sorted(set(known) - {"medium", "large"})]
    assert all(short > long for short, long in itertools.pairwise(rods))
