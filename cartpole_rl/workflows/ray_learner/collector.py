"""The TorchRL collector on the machine of the cart: it sends recorded episodes and receives weights.

TorchRL's `RayCollector` places it there by a resource. It never drives: another process does, which neither
waits for this one nor notices when it dies.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from torchrl.collectors import BaseCollector

from cartpole_rl.workflows.ray_learner.episode_files import EpisodeFiles
from cartpole_rl.workflows.ray_learner.offers import Offer


class EpisodeCollector(BaseCollector):
    """A collector that adds the episodes of a run folder to `replay_buffer` and writes weights beside them.

    `create_env_fn` holds one function that returns the files; `policy` is an `Offer` of the right size.
    What the buffer has already is not sent again: the next episode is the one of the buffer's length.
    """

    def __init__(
        self,
        create_env_fn: Sequence[Callable[[], EpisodeFiles]],
        policy: Offer,
        *,
        replay_buffer: Any,
        worker_idx: int = 0,
        **_: Any,  # settings of a collector that steps environments
    ) -> None:
        super().__init__()
        self.files, self.policy, self.replay_buffer = create_env_fn[0](), policy, replay_buffer
        self.worker_idx, self.total_frames = worker_idx, -1

    def iterator(self) -> Iterator[None]:
        """Add an episode to the buffer for each None that is yielded."""
        while True:
            number = len(self.replay_buffer)
            self.replay_buffer.add(self.files.wait_for(number))
            yield None

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Write the weights that `policy` has received; TorchRL's synchronization calls this then."""
        self.files.write_offer(self.policy.bytes())

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Do nothing: the collector owns nothing."""

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Return `seed`: nothing here is random."""
        return seed

    def state_dict(self) -> "OrderedDict[str, Any]":
        """Return no state: it is on disk and in the buffer."""
        return OrderedDict()

    def load_state_dict(self, state_dict: "OrderedDict[str, Any]") -> None:
        """Do nothing."""
