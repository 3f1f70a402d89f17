"""The collector on the cart's machine sends what is on disk, in order, and writes what arrives."""

import threading
from dataclasses import fields

import numpy as np
import torch
from torchrl.data import ListStorage, ReplayBuffer

from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.finetuning_files import FinetuningFiles, Stage
from cartpole_rl.workflows.ray_learner.collector import EpisodeCollector
from cartpole_rl.workflows.ray_learner.episode_files import (
    NUMBER,
    EpisodeFiles,
    as_tensordict,
    from_tensordict,
)
from cartpole_rl.workflows.ray_learner.offers import Offer, OfferFile, pack, unpack


def collector(files: FinetuningFiles, buffer: ReplayBuffer) -> EpisodeCollector:
    """A collector that was just started."""
    offer = Offer(pack(0, {"weight": torch.zeros(2)}))
    return EpisodeCollector([lambda: EpisodeFiles(files)], offer, replay_buffer=buffer)


def new_buffer() -> ReplayBuffer:
    return ReplayBuffer(storage=ListStorage(5), batch_size=1)


def test_an_episode_arrives_as_it_was_recorded(files: FinetuningFiles, short_episode: Episode) -> None:
    files.write_episode(Stage.BEFORE, 0, short_episode)
    buffer = new_buffer()
    collector(files, buffer).next()
    arrived = from_tensordict(buffer[0])
    for each in fields(Episode):
        expected, found = getattr(short_episode, each.name), getattr(arrived, each.name)
        assert type(expected) is type(found), each.name
        assert np.array_equal(expected, found) if isinstance(found, np.ndarray) else expected == found


def test_episodes_are_sent_in_the_order_of_the_stages(files: FinetuningFiles, short_episode: Episode) -> None:
    for stage, number in ((Stage.BEFORE, 0), (Stage.TUNE, 0), (Stage.TUNE, 1)):
        files.write_episode(stage, number, short_episode)
    buffer, sent = new_buffer(), []
    for _ in range(3):
        collector(files, buffer).next()  # a new one each time, as after a lost connection
        sent.append(int(buffer[len(buffer) - 1][NUMBER]))
    assert sent == [0, 1, 2]


def test_what_the_buffer_has_is_not_sent_again(files: FinetuningFiles, short_episode: Episode) -> None:
    """The connection may be lost between the arrival of an episode and the answer."""
    for number in range(2):
        files.write_episode(Stage.TUNE, number, short_episode)
    files.write_episode(Stage.BEFORE, 0, short_episode)
    buffer = new_buffer()
    buffer.add(as_tensordict(0, short_episode))
    buffer.add(as_tensordict(1, short_episode))
    collector(files, buffer).next()
    assert [int(buffer[number][NUMBER]) for number in range(len(buffer))] == [0, 1, 2]


def test_an_episode_is_sent_once_it_is_on_disk(files: FinetuningFiles, short_episode: Episode) -> None:
    buffer = new_buffer()
    sending = threading.Thread(target=collector(files, buffer).next)
    sending.start()
    assert len(buffer) == 0
    files.write_episode(Stage.BEFORE, 0, short_episode)
    sending.join()
    assert len(buffer) == 1


def test_weights_that_arrive_are_written(files: FinetuningFiles) -> None:
    state = {"weight": torch.tensor([1.5, -2.5])}
    receiving = collector(files, new_buffer())
    receiving.policy.fill(pack(3, state))
    receiving.update_policy_weights_()
    version, arrived = unpack(OfferFile(files.folder).next() or b"", state)
    assert version == 3
    assert torch.equal(arrived["weight"], state["weight"])
