"""A scripted cart on a pseudo-terminal."""

from collections.abc import Iterator

import pytest
from serial_peer import CartPeer


@pytest.fixture
def peer() -> Iterator[CartPeer]:
    with CartPeer() as peer:
        yield peer
