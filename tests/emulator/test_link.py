"""The emulator's end of the cable: whole frames or none, and how a bad cable disturbs them."""

import pytest
from serial_peer import wait_for

from cartpole_rl.emulator.link import Disturbance, Link, PtyLink, TcpLink
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import FrameError
from cartpole_rl.plants.serial.port import open_port
from cartpole_rl.wire.frames import decode_frame, encode_frame
from cartpole_rl.wire.messages import SetMotor

EACH_LINK = pytest.mark.parametrize("kind", [PtyLink, TcpLink])


@EACH_LINK
def test_a_host_that_does_not_read_loses_whole_frames_and_never_half_of_one(kind: type[Link]) -> None:
    first, *lost, last = (encode_frame(SetMotor(number), number) for number in range(1000))
    with kind() as link, open_port(link.port, 921600, 1.0) as host:
        link.read(5)
        long, seen = bytes([1]) * 10_000_000, bytearray()  # the buffers take less
        for frame in (first, long, *lost):
            link.offer(frame)
        while last not in seen[len(long) :]:  # the line drains, and what is new gets through again
            seen += host.read(host.in_waiting or 1)
            link.offer(last)
    assert seen.startswith(first + long + last)


@EACH_LINK
def test_a_host_that_opens_the_port_is_noticed_and_bytes_arrive(kind: type[Link]) -> None:
    with kind() as link:
        assert link.read(0) == b""
        assert not link.opened
        with open_port(link.port, 921600, 1.0) as host:
            assert link.read(5) == b""
            assert link.opened
            host.write(bytes(range(256)))
            assert link.read(5) == bytes(range(256))
            link.write(bytes(1000))
            wait_for(lambda: host.in_waiting == 1000, 20)
            assert host.read(1000) == bytes(1000)
            assert host.in_waiting == 0


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
