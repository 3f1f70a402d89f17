"""Which single poles stand for a choice of poles."""

import pytest

from cartpole_rl.randomization import Pole, PoleSettings


def test_each_choice_stands_for_itself() -> None:
    poles = {"short": Pole.rod(0.3), "long": Pole.rod(0.8)}
    each = PoleSettings(choices=poles).each
    assert [single.choices for single in each] == [{name: pole} for name, pole in poles.items()]


def test_rods_from_the_shortest_to_the_longest_stand_for_a_range() -> None:
    each = PoleSettings(lengths=(0.2, 1.0)).each
    assert [2 * single.nominal.pole_com for single in each] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert [single.name for single in each] == ["0.20 m", "0.40 m", "0.60 m", "0.80 m", "1.00 m"]
