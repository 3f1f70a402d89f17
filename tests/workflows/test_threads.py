"""The threads of torch, in a process that runs several jobs."""

from collections.abc import Iterator

import pytest
import torch

from cartpole_rl.workflows.build import use_threads


@pytest.fixture
def two() -> Iterator[None]:
    """Torch has two threads; afterwards as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def used(threads: int | None) -> int:
    use_threads(threads)
    return torch.get_num_threads()


@pytest.mark.usefixtures("two")
def test_no_number_is_that_before_an_earlier_job() -> None:
    assert [used(threads) for threads in (None, 1, None, 3, 1, None)] == [2, 1, 2, 3, 1, 2]
    torch.set_num_threads(4)  # a user's own choice
    assert [used(threads) for threads in (None, 1, None)] == [4, 1, 4]
