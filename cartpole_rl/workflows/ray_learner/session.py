"""The session on the machine of the cart, with the learner on another one.

It drives, writes each episode to disk and takes the weights that have arrived, after checking them. It needs
neither Ray nor the network: the link and TorchRL's collector are other processes.
"""

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.errors import CheckpointError
from cartpole_rl.learning.settings import RayLearnerSettings
from cartpole_rl.reporting.words import count_text
from cartpole_rl.workflows.config import EvaluateConfig
from cartpole_rl.workflows.finetuning_cart import DrivenCart
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_session import Session, TunedAgent
from cartpole_rl.workflows.person import print_message
from cartpole_rl.workflows.ray_learner.link import LearnerLink
from cartpole_rl.workflows.ray_learner.offers import OfferFile, pack, unpack
from cartpole_rl.workflows.ray_learner.task import LearnerTask

POLL = 0.1  # s between two looks for weights
LAST_CURVES = 10.0  # s to wait for the learner's last curves; they are not needed
NAME = "learner"  # in a checkpoint: the learner's name in the Ray cluster

show = partial(print_message, "finetune")


@contextmanager
def learner_link(
    files: FinetuningFiles, tuned: TunedAgent, evaluation: EvaluateConfig
) -> Iterator[LearnerLink | None]:
    """Connect to the learner of learner=ray; yield None if the learner is this process.

    A resumed run whose episodes were all learned from needs no learner either. Raises LearnerError.
    """
    settings = files.config.learner
    if not isinstance(settings, RayLearnerSettings) or tuned.learned >= files.config.episodes:
        yield None
        return
    name = tuned.state.setdefault(NAME, secrets.token_hex(8))
    save(files, tuned)

    def task() -> LearnerTask:
        return LearnerTask(
            name,
            files.folder.absolute(),
            files.config.model_dump(mode="json"),
            evaluation.model_dump(mode="json"),
            tuned.start,
            tuned.learned,
            pack(tuned.learned, tuned.agent.state_dict()),
        )

    with LearnerLink(settings.address, settings.timeout, task, show) as link:
        yield link


def save(files: FinetuningFiles, tuned: TunedAgent) -> None:
    """Write the checkpoint to resume from: the newest weights, and the name of the learner."""
    files.save({"agent": tuned.agent.state_dict(), NAME: tuned.state[NAME]}, tuned.learned)


class RaySession(Session):
    """A session whose learner is at the other end of `link`."""

    def __init__(
        self,
        files: FinetuningFiles,
        cart: DrivenCart,
        tuned: TunedAgent,
        settings: CartPoleSettings,
        link: LearnerLink,
    ) -> None:
        super().__init__(files, cart, tuned, settings)
        self.link, self.offers = link, OfferFile(files.folder)
        assert isinstance(self.config.learner, RayLearnerSettings)
        self.ahead = self.config.learner.episodes_ahead
        self.logged = 0  # episodes that the newest curves were learned from

    def tune(self) -> None:
        """Drive the episodes that are not on disk, each with the weights for it, and wait for the last ones.

        Raises LearningError if learning failed, LearnerError if the learner cannot be used.
        """
        for number in range(self.files.count(Stage.TUNE), self.config.episodes):
            self.wait_for_weights(number, self.ahead)
            self.cart.start(self.tuned.weights, self.config.finetuning.epsilon, self.config.seed + number)
            self.cart.finish(Stage.TUNE, number)
        self.wait_for_weights(self.config.episodes, 0)
        self.wait_for_last_curves()
        self.link.finish()
        self.offers.remove()

    def wait_for_weights(self, version: int, ahead: int) -> None:
        """Wait for weights that were learned from `version` episodes, while the cart stands still.

        Weights from up to `ahead` episodes fewer do while the learner is lost.
        """
        waited = False
        while True:
            self.link.poll()
            self.take_weights()
            self.log_curves()
            lacking = version - self.tuned.learned
            if lacking <= 0:
                return
            if self.link.is_lost:
                if lacking <= ahead:
                    show(f"tune {version + 1} is driven with weights from {count_text(self.tuned.learned)}")
                    return
                if not waited:
                    show("the cart waits for the learner; Ctrl-C stops, resume= continues")
                waited = True
            time.sleep(POLL)

    def take_weights(self) -> None:
        """Take the newest weights that arrived, if they are whole, finite and newer than the present ones."""
        packed = self.offers.next()
        if packed is None:
            return
        try:
            version, weights = unpack(packed, self.tuned.agent.state_dict())
        except CheckpointError as error:
            show(str(error))
            return
        if self.tuned.learned < version <= self.config.episodes:
            self.tuned.agent.load_state_dict(weights)
            self.tuned.learned = version
            save(self.files, self.tuned)

    def log_curves(self) -> None:
        """Write the learner's curves beside those of the cart."""
        for learned, scalars in self.link.take_curves():
            self.cart.log.scalars(scalars, self.cart.step(Stage.TUNE, learned))
            self.logged = learned

    def wait_for_last_curves(self) -> None:
        """Wait for the curves after the last episode, which arrive by another way than the weights."""
        end = time.monotonic() + LAST_CURVES
        while self.logged < self.config.episodes and time.monotonic() < end:
            self.link.poll()
            self.log_curves()
            time.sleep(POLL)
