"""Errors keep their message and attributes when they are pickled."""

import pickle
from collections.abc import Iterator

import pytest

import cartpole_rl.workflows.finetune  # noqa: F401 - imports every module that defines an error
from cartpole_rl.errors import CartPoleError
from cartpole_rl.plants.serial.errors import NotReadyError, RefusedError
from cartpole_rl.wire.messages import Reason


def descendants(kind: type[CartPoleError]) -> Iterator[type[CartPoleError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from descendants(child)


MADE_WITH = {
    RefusedError: ("the cart refused START", Reason.NOT_HOMED),
    NotReadyError: ("it rolls", "level it"),
}


@pytest.mark.parametrize("kind", sorted(descendants(CartPoleError), key=lambda kind: kind.__name__))
def test_an_error_survives_pickling(kind: type[CartPoleError]) -> None:
    error = kind(*MADE_WITH.get(kind, ("what is wrong",)))
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error)
    assert vars(again) == vars(error)
