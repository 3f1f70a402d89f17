"""The PID controller of the studies."""

import pytest
import torch
from pid import FORCES, Pid

from cartpole_rl.choices import choice


def force(*state: float) -> float:
    """Return the force for x, x_dot, theta, theta_dot, N."""
    return float(FORCES[Pid()(torch.tensor([state])).argmax()])


@pytest.mark.parametrize("state", [(0.1, 0, 0, 0), (0, 0.1, 0, 0), (0, 0, 0.05, 0), (0, 0, 0, 0.3)])
def test_it_pushes_under_the_pole_and_from_where_the_cart_must_lean_back(state: tuple[float, ...]) -> None:
    assert force(*state) > 0
    assert force(*(-number for number in state)) == -force(*state)


def test_it_integrates_a_lasting_error_until_the_pole_falls() -> None:
    controller, leaning = Pid(), torch.tensor([[0.0, 0.0, 0.009, 0.0]])
    first = controller(leaning)
    later = [controller(leaning) for _ in range(60)][-1]
    assert FORCES[later.argmax()] > FORCES[first.argmax()]
    controller(torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
    assert controller(leaning).equal(first)


def test_its_forces_are_those_of_the_nine_levels() -> None:
    motors = choice("actions/nine_levels")["motors"]
    assert [float(each) for each in FORCES.sign()] == [float((each > 0) - (each < 0)) for each in motors]
    assert len(motors) == len(FORCES)
