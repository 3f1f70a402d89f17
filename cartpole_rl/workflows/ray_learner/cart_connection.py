"""The learner's connection to the cart: TorchRL's Ray collector, weight synchronization and replay buffer.

It is made again whenever the cart's Ray node was lost and has returned. The buffer stays with the learner, so
episodes arrive once; those that were driven in between are on the cart's disk and are sent then.
"""

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from tensordict import TensorDictBase
from torchrl.collectors.distributed import RayCollector
from torchrl.data import ListStorage, ReplayBuffer

from cartpole_rl.workflows.ray_learner.collector import EpisodeCollector
from cartpole_rl.workflows.ray_learner.episode_files import NUMBER, EpisodeFiles
from cartpole_rl.workflows.ray_learner.offers import Offer

POLL = 0.2  # s
ALIVE_POLL = 3.0  # s between two questions to the collector
CALLS = 4  # that the collector answers at once: it waits for an episode while weights arrive


class CartConnection:
    """A thread that fills `buffer` with the cart's episodes and sends it the newest offer of weights.

    `cart` is the Ray resource of the cart's node, `make_files` returns its run folder there, and `first` is
    an offer of the right size.
    """

    def __init__(
        self, cart: str, make_files: Callable[[], EpisodeFiles], episodes: int, first: bytes
    ) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self.cart, self.make_files = cart, make_files
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self.buffer = ReplayBuffer(
            storage=partial(ListStorage, episodes),
            batch_size=1,
            service_backend="ray",
            service_backend_options={"remote_config": {"num_cpus": 0, "scheduling_strategy": here}},
        )
        self._offer = Offer(first)
        self._newest: bytes | None = None  # to be sent; None once it has arrived
        self._lock = threading.Lock()
        threading.Thread(target=self._serve, name="cart connection", daemon=True).start()

    def offer(self, packed: bytes) -> None:
        """Send weights as soon as the cart can be reached, in place of those that are still to be sent."""
        with self._lock:
            self._newest = packed

    def episode(self, number: int) -> TensorDictBase:
        """Wait for episode `number`, and return it."""
        while len(self.buffer) <= number:
            time.sleep(POLL)
        tensors: TensorDictBase = self.buffer[number]
        assert int(tensors[NUMBER]) == number
        return tensors

    def _serve(self) -> None:
        """Connect, exchange, and connect again after an error, until the process ends."""
        last: bytes | None = None  # the newest offer: a new collector gets it even if an earlier one had it
        while True:
            collector = None
            with suppress(Exception):  # of Ray, TorchRL or Gloo: all mean that the cart is not reached
                self._wait_for_cart()
                collector = self._make_collector()
                self._newest = self._newest or last
                collecting = threading.Thread(target=_collect, args=(collector,), daemon=True)
                collecting.start()
                while collecting.is_alive() and collector.stats()["workers_alive"]:
                    last = self._send(collector) or last
            with suppress(Exception):
                if collector is not None:
                    collector.shutdown()

    def _wait_for_cart(self) -> None:
        import ray

        while self.cart not in ray.cluster_resources():
            time.sleep(POLL)

    def _make_collector(self) -> RayCollector:
        return RayCollector(
            [self.make_files],
            self._offer,
            collector_class=EpisodeCollector,
            frames_per_batch=1,
            total_frames=sys.maxsize,
            remote_configs={"num_cpus": 0, "resources": {self.cart: 1}, "max_concurrency": CALLS},
            replay_buffer=self.buffer,
        )

    def _send(self, collector: RayCollector) -> bytes | None:
        """Send offers for ALIVE_POLL s; return the last one that arrived."""
        sent, end = None, time.monotonic() + ALIVE_POLL
        while time.monotonic() < end:
            with self._lock:
                newest = self._newest
            if newest is not None:
                self._offer.fill(newest)
                collector.update_policy_weights_()
                sent = newest
                with self._lock:
                    if self._newest is newest:
                        self._newest = None
            time.sleep(POLL)
        return sent


def _collect(collector: RayCollector) -> None:
    """Let the collector fill the buffer, until the cart is lost."""
    with suppress(Exception):
        for _ in collector:
            pass
