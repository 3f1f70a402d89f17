"""The text of an episode's end."""

import dataclasses

import pytest

from cartpole_rl.reporting.words import ENDINGS, ending_text
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode


def test_every_ending_has_a_text_of_its_own() -> None:
    assert set(ENDINGS) == set(Ending)
    assert len(set(ENDINGS.values())) == len(Ending)


@pytest.mark.parametrize("ending", Ending)
def test_the_text_has_the_duration(ending: Ending, balance: Episode) -> None:
    later = dataclasses.replace(balance, ended_by=ending, time=balance.time + 5)
    assert ending_text(later) == f"{ENDINGS[ending]} after 10.0 s"
