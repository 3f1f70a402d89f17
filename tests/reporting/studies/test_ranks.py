"""Whether the order of agents in simulation predicts that on the cart, in one figure and one sentence."""

import numpy as np
import pytest

from cartpole_rl.reporting.studies.ranks import rank_agreements
from cartpole_rl.reporting.studies.results import Agent, StudyResults
from cartpole_rl.reporting.studies.settings import Evaluation, Size, Study, Variant

Pair = tuple[float, float]
CARTS = tuple(Evaluation(name=name, label=f"{name} cart") for name in ("simulated", "emulated"))


def results(name: str, *arms: list[Pair], measure: str = "score", shared: str = "") -> StudyResults:
    """Results of a study on two carts; each arm has an agent for each pair, the first those of `shared`."""
    variants = tuple(
        Variant(
            name=f"arm_{number}",
            label=f"arm {number}",
            overrides=(f"run={{runs}}/{shared}/{{seed}}",) if shared and not number else (),
        )
        for number, _ in enumerate(arms)
    )
    study = Study(
        title=name,
        order=90,
        question="Why?",
        measure=measure,
        arms=variants,
        evaluations=CARTS,
        sizes={"full": Size(seeds=2)},
    )
    agents = (
        Agent(variant.name, seed, f"runs/{name}/{seed}", {"simulated": first, "emulated": second})
        for variant, pairs in zip(variants, arms, strict=True)
        for seed, (first, second) in enumerate(pairs)
    )
    return StudyResults(name, study, tuple(agents))


SHARED: list[Pair] = [(1, 2), (2, 3), (3, 1), (4, 4)]


def test_agents_that_several_studies_share_agree_once() -> None:
    two = results("two", SHARED, [(5, 5), (6, 9)], shared="one/arm_0")
    (drawing,) = rank_agreements([results("one", SHARED), two])
    assert drawing.caption.startswith("6 agents of 2 studies")
    assert rank_agreements([results("few", SHARED[:2])]) == []


def test_different_agents_with_the_same_scores_are_all_ranked() -> None:
    (drawing,) = rank_agreements([results("one", [(0, 0), (0, 0), (0, 0), (1, 2), (3, 4)])])
    assert drawing.caption.startswith("5 agents of 1 studies")


def test_agents_of_each_score_are_ranked_among_themselves() -> None:
    swings = results("one", SHARED[:3])
    balances = results("two", [(5, 5), (6, 9), (7, 8), (8, 9)], measure="score_upright")
    assert [each.caption.partition(" ")[0] for each in rank_agreements([swings, balances])] == ["3", "4"]


@pytest.mark.parametrize(
    ("noise", "sign", "verdict"),
    [
        (0.0, 1, "predicts well"),
        (0.7, 1, "predicts in part"),
        (9.0, 1, "is not shown to predict"),
        (0.0, -1, "contradicts"),
    ],
)
def test_the_answer_is_computed_from_the_rank_correlation(noise: float, sign: int, verdict: str) -> None:
    generator = np.random.default_rng(2)
    simulated = generator.normal(size=40)
    emulated = sign * simulated + noise * generator.normal(size=40)
    (drawing,) = rank_agreements([results("one", [*zip(simulated.tolist(), emulated.tolist(), strict=True)])])
    start = f"Score (6.2): the order on the simulated cart {verdict} that on the emulated cart"
    assert drawing.answer.startswith(start)
    assert "over 40 agents the rank correlation is " in drawing.answer


def test_three_agents_have_no_interval_and_no_answer() -> None:
    (drawing,) = rank_agreements([results("one", SHARED[:3])])
    assert drawing.answer == "Score (6.2): too few agents for a rank correlation with an interval."


def test_colours_do_not_tell_many_studies_apart() -> None:
    many = [results(f"study_{number}", [(number, 2 * number + 1)]) for number in range(9)]
    (drawing,) = rank_agreements(many)
    assert drawing.caption.endswith("Colours do not distinguish the studies.")
