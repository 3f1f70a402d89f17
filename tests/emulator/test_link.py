"""The emulator's end of the cable passes on whole frames or none."""

import os
import tty

import serial

from cartpole_rl.emulator.link import PtyLink
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
