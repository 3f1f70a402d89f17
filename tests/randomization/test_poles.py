"""The poles that represent a choice, and the order in which carts carry them."""

import pytest
import torch

from cartpole_rl.choices import choice
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer


def test_each_choice_represents_itself() -> None:
    poles = {"short": Pole.rod(0.3), "long": Pole.rod(0.8)}
    each = PoleSettings(choices=poles).each
    assert each.choices == poles
    assert each.in_turn


def test_rods_from_the_shortest_to_the_longest_represent_a_range() -> None:
    each = PoleSettings(lengths=(0.2, 1.0)).each
    assert each.choices is not None
    assert [2 * pole.pole_com for pole in each.choices.values()] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert list(each.choices) == ["0.20 m", "0.40 m", "0.60 m", "0.80 m", "1.00 m"]


def test_poles_in_turn_repeat_cyclically() -> None:
    poles = PoleSettings(choices={"short": Pole.rod(0.3), "long": Pole.rod(0.8)}, in_turn=True)
    table = Randomizer(choice("cart/ip02"), poles, {}).draw(5, torch.Generator().manual_seed(0))
    lengths = CartParameters.from_table(table).pole_length
    assert lengths.tolist() == pytest.approx([0.3, 0.8, 0.3, 0.8, 0.3])
