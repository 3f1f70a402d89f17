"""Lets a module of tests run with the Python firmware and again with the C firmware."""

from collections.abc import Iterator

import pytest
from firmwares import UnderTest, needs_compiler


@pytest.fixture(scope="module", params=["python", pytest.param("c", marks=needs_compiler)])
def each_firmware(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let `make_firmware` and `Driven` use one firmware, then the other."""
    UnderTest.kind = request.param
    yield
    UnderTest.kind = "python"
