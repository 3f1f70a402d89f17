"""The emulator's end of the cable: whole frames or none, and how a bad cable disturbs them."""

import os
import tty

import pytest
import serial

from cartpole_rl.emulator.link import Disturbance, PtyLink
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import FrameError
from cartpole_rl.wire.frames import FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import SetMotor


def test_a_host_that_does_not_read_loses_whole_frames_and_never_half_of_one():
    with PtyLink() as link:
        host = os.open(link.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(host)
        for number in range(5000):
            link.offer(encode_frame(SetMotor(number), number))
        came = []
        splitter = FrameSplitter()
        for number in range(5000, 5100):  # the line drains, and what is new gets through again
            while True:
                try:
                    came += [decode_frame(stuffed) for stuffed in splitter.feed(os.read(host, 4096))]
                except BlockingIOError:
                    break
            link.offer(encode_frame(SetMotor(number), number))
        os.close(host)
    motors = [frame.message.motor for frame in came]
    assert motors == sorted(set(motors))
    assert motors[0] == 0
    assert 100 < len(motors) < 5000
    assert motors[-1] > 5000


def test_a_host_that_opens_the_port_is_noticed():
    with PtyLink() as link:
        assert link.read(0) == b""
        assert not link.opened
        with serial.Serial(link.port) as host:
            host.write(b"hello")
            assert link.read(5) == b"hello"
            assert link.opened


FRAME = encode_frame(SetMotor(-200), 4)[:-1]


def test_an_intact_cable_changes_nothing():
    cable = Disturbance(EmulatorSettings(), "inward")
    assert all(cable.carry(FRAME) == [FRAME] for _ in range(100))


def test_shares_of_lost_and_damaged_frames_are_those_of_the_settings():
    cable = Disturbance(EmulatorSettings(frame_loss=0.2, frame_corruption=0.3), "inward")
    came = [cable.carry(FRAME) for _ in range(4000)]
    arrived = [frame for frames in came for frame in frames]
    damaged = [frame for frame in arrived if frame != FRAME]
    assert 1 - len(arrived) / len(came) == pytest.approx(0.2, abs=0.03)
    assert len(damaged) / len(arrived) == pytest.approx(0.3, abs=0.03)
    for frame in damaged:
        assert 0 not in frame
        with pytest.raises(FrameError):
            decode_frame(frame)


def test_the_seed_decides_which_frames_are_disturbed():
    def pattern(seed: int, direction: str = "inward") -> list[list[bytes]]:
        cable = Disturbance(
            EmulatorSettings(
                seed=seed, frame_loss=0.3, frame_corruption=0.3, frame_duplication=0.3, frame_reordering=0.3
            ),
            direction,
        )
        return [cable.carry(FRAME) for _ in range(50)]

    assert pattern(1) == pattern(1)
    assert pattern(1) != pattern(2)
    assert pattern(1) != pattern(1, "outward")


def numbered(cable: Disturbance, count: int = 4000) -> list[int]:
    """Return the numbers of the frames that arrive, in order."""
    came = [cable.carry(encode_frame(SetMotor(number), number)[:-1]) for number in range(count)]
    return [decode_frame(frame).message.motor for frames in came for frame in frames]


def test_the_share_of_duplicated_frames_is_that_of_the_settings():
    came = numbered(Disturbance(EmulatorSettings(frame_duplication=0.2), "inward"))
    assert came == sorted(came)
    assert set(came) == set(range(4000))
    assert len(came) / 4000 - 1 == pytest.approx(0.2, abs=0.03)


def test_the_share_of_reordered_frames_is_that_of_the_settings_and_each_is_late_by_one():
    came = numbered(Disturbance(EmulatorSettings(frame_reordering=0.1), "inward"))
    assert sorted(came) == list(range(len(came)))
    assert len(came) >= 3999  # the last may be withheld
    late = [number for place, number in enumerate(came) if number < place]
    assert all(came[number] == number + 1 for number in late)
    assert len(late) / 4000 == pytest.approx(0.1 / 1.1, abs=0.02)  # a frame after a late one is not late
