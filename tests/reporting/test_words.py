"""Texts that several figures share."""

import dataclasses

import pytest

from cartpole_rl.reporting.words import ending_text
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode


@pytest.mark.parametrize("ending", list(Ending))
def test_every_ending_has_words(ending: Ending, balance: Episode) -> None:
    assert ending_text(dataclasses.replace(balance, ended_by=str(ending))).endswith(" after 10.0 s")
