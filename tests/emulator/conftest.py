"""Lets a module of tests run with the C firmware and, nightly, again with the Python firmware.

That both answer alike to the byte is asserted daily, in test_c_firmware.py and fuzz/test_two_firmwares.py.
"""

from collections.abc import Iterator

import pytest
from firmwares import UnderTest, needs_compiler


@pytest.fixture(
    scope="module",
    params=[pytest.param("python", marks=pytest.mark.nightly), pytest.param("c", marks=needs_compiler)],
)
def each_firmware(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let `make_firmware` and `Driven` use one firmware, then the other."""
    UnderTest.kind = request.param
    yield
    UnderTest.kind = "python"
