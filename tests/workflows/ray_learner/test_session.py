"""The session on the cart's machine: which weights drive which episode, with and without a learner."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from cartpole_rl.evaluation.driving_policy import Weights
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, AgentCheckpoint, load_training
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import new_agent
from cartpole_rl.workflows.build import evaluated_settings
from cartpole_rl.workflows.config import TrainConfig
from cartpole_rl.workflows.finetune import evaluation_config
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_session import TunedAgent
from cartpole_rl.workflows.loading import load_settings
from cartpole_rl.workflows.ray_learner.offers import pack, write_offer
from cartpole_rl.workflows.ray_learner.session import NAME, RaySession

TRAINING = load_settings(TrainConfig, {"agent.hidden": [8, 8]})


class Link:
    """A link whose network is `happen`, which is called at each look."""

    def __init__(self) -> None:
        self.is_lost, self.is_finished = False, False
        self.happen: Callable[[], None] = lambda: None

    def poll(self) -> None:
        self.happen()

    def take_curves(self) -> list[Any]:
        return []

    def finish(self) -> None:
        self.is_finished = True


class Cart:
    """A cart that drives at once; `driven` holds a weight of each episode."""

    def __init__(self, files: FinetuningFiles, episode: Episode) -> None:
        self.files, self.episode = files, episode
        self.driven: list[float] = []

    def start(self, weights: Weights, epsilon: float, seed: int) -> None:
        self.driven.append(float(next(iter(weights.values())).flat[0]))

    def finish(self, stage: Stage, number: int) -> None:
        self.files.write_episode(stage, number, self.episode)


def state_of(version: float, network: dict[str, Any] | None = None) -> dict[str, Any]:
    """The state of an agent whose weights are all `version`."""
    state = network or new_agent(TRAINING).state_dict()
    return {
        name: torch.full_like(weight, version) if weight.is_floating_point() else weight
        for name, weight in state.items()
    }


@pytest.fixture
def session(files: FinetuningFiles, short_episode: Episode, monkeypatch: pytest.MonkeyPatch) -> RaySession:
    """A session with the weights 0."""
    monkeypatch.setattr("cartpole_rl.workflows.ray_learner.session.POLL", 0.0)
    monkeypatch.setattr("cartpole_rl.workflows.ray_learner.session.LAST_CURVES", 0.0)
    start = AgentCheckpoint(TRAINING.model_dump(mode="json"), state_of(0), 0, None)
    tuned = TunedAgent(TRAINING, start, None)
    tuned.state[NAME] = "run"
    settings = evaluated_settings(TRAINING, evaluation_config(files.config))
    return RaySession(files, Cart(files, short_episode), tuned, settings, Link())


def offer(session: RaySession, version: int, value: float | None = None) -> None:
    """Let weights arrive."""
    state = state_of(version if value is None else value)
    write_offer(session.files.folder, pack(version, state))


def test_each_episode_is_driven_with_the_weights_from_all_earlier_ones(session: RaySession) -> None:
    offered = []

    def learn() -> None:
        """Offer weights from the episodes that are on disk, once."""
        if (count := session.files.count(Stage.TUNE)) not in offered:
            offered.append(count)
            offer(session, count)

    session.link.happen = learn
    session.tune()
    assert session.cart.driven == [0, 1, 2, 3]
    assert session.tuned.learned == 4
    assert session.link.is_finished
    assert not session.offers.path.exists()


def test_a_slow_learner_is_waited_for(session: RaySession) -> None:
    looks = []

    def learn() -> None:
        looks.append(session.files.count(Stage.TUNE))
        if looks.count(looks[-1]) == 50:
            offer(session, looks[-1])

    session.link.happen = learn
    session.tune()
    assert session.cart.driven == [0, 1, 2, 3]


def test_without_a_learner_the_cart_drives_a_few_episodes_and_waits(session: RaySession) -> None:
    looks = []

    def lose() -> None:
        session.link.is_lost = True
        looks.append(session.files.count(Stage.TUNE))
        if looks.count(3) > 50:
            raise KeyboardInterrupt

    session.link.happen = lose
    with pytest.raises(KeyboardInterrupt):
        session.tune()
    assert session.cart.driven == [0, 0, 0]  # the first one needs no learner; 2 more are allowed
    assert looks.count(3) == 51


def test_when_the_learner_returns_it_catches_up_first(session: RaySession) -> None:
    looks = []

    def return_late() -> None:
        count = session.files.count(Stage.TUNE)
        looks.append(count)
        session.link.is_lost = looks.count(3) < 10
        if not session.link.is_lost:
            offer(session, min(session.tuned.learned + 1, count))

    session.link.happen = return_late
    session.tune()
    assert session.cart.driven == [0, 0, 0, 3]
    assert session.tuned.learned == 4


@pytest.mark.parametrize(
    "arrive",
    [
        lambda session: offer(session, 1, float("nan")),
        lambda session: offer(session, 0, 7.0),
        lambda session: offer(session, -1, 7.0),
        lambda session: offer(session, 5, 7.0),
        lambda session: write_offer(session.files.folder, b"half"),
        lambda session: write_offer(session.files.folder, pack(1, {"weight": torch.full((3,), 7.0)})),
    ],
    ids=["nan", "same", "stale", "beyond the run", "half", "another network"],
)
def test_weights_that_cannot_be_used_never_drive(
    arrive: Callable[[RaySession], None], session: RaySession
) -> None:
    arrive(session)
    session.take_weights()
    assert session.tuned.learned == 0
    assert not any(weight.any() for weight in session.tuned.weights.values())


def test_weights_that_arrived_are_kept_for_a_resumption(session: RaySession) -> None:
    offer(session, 2)
    session.take_weights()
    saved = load_training(session.files.folder, FINETUNING_FORMAT)
    again = TunedAgent(TRAINING, session.tuned.start, saved)
    assert again.learned == 2
    assert again.state[NAME] == "run"
    assert isinstance(again.agent, QAgent)
    expected = session.tuned.agent.state_dict()
    assert all(torch.equal(expected[name], weight) for name, weight in again.agent.state_dict().items())
