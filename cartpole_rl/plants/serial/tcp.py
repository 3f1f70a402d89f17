"""A port behind TCP, socket://HOST:PORT: an emulated cart, or a bridge such as ser2net."""

import socket

from serial.urlhandler.protocol_socket import Serial

COUNTED = 1 << 16  # bytes


class TcpPort(Serial):
    """pyserial's port of this kind, which counts at most one waiting byte and collects small frames."""

    def open(self) -> None:
        """Open the port; frames are sent at once. Raises SerialException."""
        super().open()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def in_waiting(self) -> int:
        """The number of bytes that have arrived, up to COUNTED. Raises OSError."""
        try:
            return len(self._socket.recv(COUNTED, socket.MSG_PEEK))
        except BlockingIOError:
            return 0
