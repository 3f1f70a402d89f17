"""The page of studies: its contents, its anchors, its commands and the ids of its figures."""

import re
from dataclasses import replace

import pytest

from cartpole_rl.checking import checked
from cartpole_rl.reporting.studies.page import studies_page
from cartpole_rl.reporting.studies.results import Agent, StudyResults
from cartpole_rl.reporting.studies.sections import run_list
from cartpole_rl.reporting.studies.settings import Study


def results(name: str, order: int, shipped: bool, label: str = "one arm", agents: int = 3) -> StudyResults:
    study = checked(
        Study,
        {
            "title": f"Study {name}",
            "order": order,
            "question": "Why?",
            "arms": [{"name": "arm", "label": label}],
            "sizes": {"quick": {"seeds": 1}},
        },
    )
    made = tuple(Agent("arm", seed, f"runs/arm/{seed}", {"own": float(seed)}) for seed in range(agents))
    return StudyResults(name, study, made, folder=f"here/quick/{name}", shipped=shipped)


def contents(page: str) -> str:
    return page[page.index('id="contents"') : page.index("</nav>")]


def test_every_study_is_in_the_contents_whatever_its_order() -> None:
    found = [results(f"n{order}", order, True) for order in (10, 195, 200)]
    found += [results(f"own{order}", order, False) for order in (-3, 0, 5, 10, 195, 250)]
    listed = contents(studies_page(found, {}))
    assert all(f'href="#study-{each.name}"' in listed for each in found)
    assert listed.count("no study") == 17
    assert listed.index("study-n195") > listed.index("Beyond the thesis")
    assert listed.index("study-own10") > listed.index("Own studies")


def test_own_studies_are_listed_plainly_with_the_command_that_finds_them() -> None:
    page = studies_page([results("mine", 180, False), results("other", 3, False)], {})
    assert "no study" not in page
    assert "The list of the thesis" not in page
    assert "#study-other" in contents(page)
    assert "scripts/reproduce mine --studies FOLDER --folder here --size quick" in page
    shipped = studies_page([results("shipped", 180, True)], {})
    assert "scripts/reproduce shipped --size quick" in shipped


def test_notes_on_how_runs_were_made_stand_with_their_list() -> None:
    notes = ("one arm: each agent has its own cart, from a run of its seed.", "The runs are of 2 commits.")
    page = studies_page([replace(results("a", 0, True), notes=notes)], {})
    assert "<aside" not in page
    assert all(note in page for note in notes)
    assert "<aside" in studies_page([replace(results("a", 0, True), notes=("One is odd.",))], {})


def test_the_seeds_are_those_of_the_results() -> None:
    assert "{seed}: one run for each seed (0 to 2 here)." in studies_page([results("a", 0, True)], {})
    assert "{seed}: one run for each seed." in studies_page([results("a", 0, True, agents=1)], {})


@pytest.mark.parametrize(
    ("figure", "place"),
    [
        ("6.8", "Fig. 6.8"),
        ("6.13a", "Fig. 6.13a"),
        ("5.2, 5.3, 5.5", "Fig. 5.2, 5.3, 5.5"),
        ("3.1.3", "Section 3.1.3"),
        ("7", "Section 7"),
        ("table 6.3", "table 6.3"),
        ("", ""),
    ],
)
def test_the_place_in_the_thesis(figure: str, place: str) -> None:
    study = results("a", 0, True).study.model_copy(update={"figure": figure})
    assert study.place == place


def test_no_name_leaves_an_attribute() -> None:
    page = studies_page([results('a"><img src=x>', 0, False), results("b", 0, False)], {})
    assert "<img" not in page
    assert 'id="study-a---img-src-x-"' in page


def test_the_same_figure_of_two_studies_has_two_sets_of_ids() -> None:
    page = studies_page([results("one", 0, False), results("two", 0, False)], {})
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) > 4
    assert len({*ids}) == len(ids)


def test_labels_are_no_formulas() -> None:
    for label in ("cost $5 to $6", r"price $\foo$", "a\x00b"):
        page = studies_page([results("one", 0, False, label)], {})
        drawn = re.findall(r"<text[^>]*>([^<]*)</text>", page)
        assert label.replace("\x00", "") in drawn


def test_a_list_that_leaves_runs_out_says_so() -> None:
    assert "The 1500 runs behind it: the first 1000<" in run_list(results("many", 0, False, agents=1500))
    assert "The 3 runs behind it<" in run_list(results("few", 0, False))
