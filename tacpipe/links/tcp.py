"""TCP connections to a device, alone or with the data coming by UDP."""

from __future__ import annotations

import select
import socket
import time

from tacpipe.links import network, udp
from tacpipe.links.link import LinkLostError
from tacpipe.links.opened import Arrived, Descriptor
from tacpipe.sensors.sensor import Sensor

MOST = 1 << 16  # bytes a read


def open_tcp(place: str, sensor: Sensor, name: str) -> TcpLink:
    """Return an open connection. Raises `DeviceError` for a host that is unknown, unreachable, or refuses."""
    host, port = network.place("tcp", place)
    return TcpLink(name, network.connect(host, port, name))


def open_both(place: str, sensor: Sensor, name: str) -> ControlledLink:
    """Return a connection for control with a free local UDP port for data. Raises `DeviceError` as `open_tcp`."""
    host, port = network.place("tcp+udp", place)
    control = TcpLink(name, network.connect(host, port, name))
    own = control.socket.getsockname()[0]
    return ControlledLink(name, udp.bound(own, 0, name), control, prompt=udp.hurries(sensor))


class TcpLink(Descriptor):
    """A connection whose bytes come as they come."""

    def __init__(self, name: str, connection: socket.socket) -> None:
        super().__init__(name, connection.fileno())
        self.socket = connection

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        try:
            data = self.socket.recv(MOST)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self.lost(error.strerror or str(error)) from error
        if not data:
            raise self.lost("the other end closed the connection")
        return [(time.monotonic_ns(), data)]

    def _release(self) -> None:
        self.socket.close()
        super()._release()


class ControlledLink(udp.UdpLink):
    """Datagrams that a device sends as long as its control connection stands, which `write` and dialogues go over."""

    def __init__(self, name: str, data: socket.socket, control: TcpLink, *, prompt: bool) -> None:
        super().__init__(name, data, prompt=prompt)
        self.control = control
        self._poll.register(control.socket.fileno(), select.POLLIN)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        if any(fileno == self.control.socket.fileno() for fileno, _ in ready):
            try:
                self.control.read(0)  # beyond a dialogue nothing comes there but its end
            except LinkLostError as error:
                self._failed = error
        return super()._fetch(ready)

    def _send(self, data: bytes) -> None:
        self.control.write(data)

    def _release(self) -> None:
        self.control.close()
        super()._release()
