"""Connect to a device by TCP, with data over the connection or over UDP."""

from __future__ import annotations

import select
import socket
import time

from tacpipe.links import network, udp
from tacpipe.links.link import Arrived, Descriptor, LinkLostError
from tacpipe.sensors.sensor import Sensor

MOST = 1 << 16  # bytes per read


def open_tcp(place: str, sensor: Sensor, name: str) -> TcpLink:
    """Return an open connection. Raises `DeviceError` for a host that is unknown, unreachable, or refuses."""
    host, port = network.place("tcp", place)
    return TcpLink(name, network.connect(host, port, name))


def open_both(place: str, sensor: Sensor, name: str) -> ControlledLink:
    """Return a control connection with a free local UDP port for data. Raises `DeviceError` as `open_tcp`."""
    host, port = network.place("tcp+udp", place)
    control = TcpLink(name, network.connect(host, port, name))
    local_host = control.socket.getsockname()[0]
    return ControlledLink(name, udp.bind_port(local_host, 0, name), control, prompt=udp.needs_prompt_reads(sensor))


class TcpLink(Descriptor):
    """A TCP connection."""

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
    """Datagrams of a device that sends while its control connection is open. `write` and dialogues use the connection."""

    def __init__(self, name: str, data: socket.socket, control: TcpLink, *, prompt: bool) -> None:
        super().__init__(name, data, prompt=prompt)
        self.control = control
        self._poll.register(control.socket.fileno(), select.POLLIN)

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        if any(fileno == self.control.socket.fileno() for fileno, _ in ready):
            try:
                self.control.read(0)  # after the dialogue only the end of the connection comes here
            except LinkLostError as error:
                self._failed = error
        return super()._fetch(ready)

    def _send(self, data: bytes) -> None:
        self.control.write(data)

    def _release(self) -> None:
        self.control.close()
        super()._release()
