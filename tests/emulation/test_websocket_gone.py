"""Test a websocket whose client has disconnected when the emulated device closes it."""

import errno
import socket
from typing import Any

import pytest

from tacpipe.simulation.emulation import network


class Gone(socket.socket):
    """A connection whose other end was closed."""

    def shutdown(self, mode: int) -> None:
        """Fail as the kernel does."""
        raise OSError(errno.ENOTCONN, "Transport endpoint is not connected")

    def send(self, data: Any, flags: int = 0) -> int:
        """Fail as the kernel does."""
        raise BrokenPipeError


class Protocol:
    """A protocol that has a last word and the end of the stream to send."""

    def __init__(self, pieces: list[bytes]) -> None:
        self.pieces = pieces

    def receive_data(self, data: bytes) -> None:
        """Take it."""

    def events_received(self) -> list[Any]:
        """Return nothing."""
        return []

    def data_to_send(self) -> list[bytes]:
        """Return what is left to send."""
        return self.pieces


@pytest.mark.parametrize("pieces", [[b""], [b"bye", b""]])
def test_a_client_that_is_gone_already_ends_no_emulation(pieces: list[bytes]) -> None:
    with Gone() as connection:
        peer: Any = object.__new__(network.Client)
        peer.socket, peer.protocol = connection, Protocol(pieces)
        served: Any = object.__new__(network.Websocket)

        assert served.from_wire(peer, b"") == []
