"""Where forecasts go: to the session's own streams, and to its subscribers. None of them is waited for."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from tacpipe.errors import UsageError
from tacpipe.live import messages
from tacpipe.live.messages import About, Published
from tacpipe.live.options import OWN, Options
from tacpipe.plugins import extras
from tacpipe.printable import excerpt
from tacpipe.recording import rig as rigs
from tacpipe.sensors.live import Live

EXAMPLES = {
    "ws": "ws:127.0.0.1:8765",
    "udp": "udp:127.0.0.1:9000, or udp:127.0.0.1:9000?format=msgpack",
    "lsl": "lsl:tacpipe",
    "mcap": "mcap:session.mcap",
}


class Publisher(Protocol):
    """Takes messages without ever waiting for who reads them."""

    dropped: int  # messages that did not go out, over all subscribers

    def publish(self, message: Published) -> None:
        """Send a message, or drop it."""

    def close(self) -> None:
        """Send what still waits and close."""


class Predicts(Protocol):
    """What is used of an engine."""

    def about(self, model: str) -> About:
        """Return what its messages are, made by a model of a path."""


class Own:
    """The packets that the recording process reads as streams of the rig."""

    def __init__(self, places: Mapping[str, tuple[str, int]], sensors: Mapping[str, Live]) -> None:
        self.dropped = 0
        self._places, self._sensors = places, sensors
        self._sent = dict.fromkeys(sensors, 0)  # packets so far, of each output
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def publish(self, message: Published) -> None:
        """Send the packets of a message."""
        for output, sensor in self._sensors.items():
            for packet in messages.packets(message, sensor, self._sent[output]):
                self._sent[output] = (self._sent[output] + 1) % (1 << 32)
                try:
                    self._socket.sendto(packet, self._places[output])
                except OSError:
                    self.dropped += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Publishers:
    """All publishers of a session; the session's own streams come last, so that the latency they carry covers the others."""

    def __init__(self, several: list[Publisher], own: Own | None, kind: str = "forecast") -> None:
        self.kind = kind  # of the messages
        self._subscribed = several
        self._own = own
        self.states: Mapping[str, str] = {}  # what was published last, in words

    @property
    def _several(self) -> list[Publisher]:
        return [*self._subscribed, *([] if self._own is None else [self._own])]

    @property
    def dropped(self) -> int:
        """How many messages did not go out."""
        return sum(one.dropped for one in self._several)

    def publish(self, message: Published, stamped: Callable[[Any], None]) -> None:
        """Send a message to all; ``stamped`` writes into it how long it took so far."""
        stamped(message)
        for one in self._subscribed:
            one.publish(message)
        stamped(message)
        if self._own is not None:
            self._own.publish(message)
        self.states = message.states

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in self._several:
            with contextlib.suppress(OSError):
                one.close()


def opened(options: Options, engine: Predicts) -> Publishers:
    """Return the publishers of a session. Raises `UsageError` for an address that is none, `DeviceError` for one in use."""
    rig = rigs.parse(options.rig)
    own = {name: rig.streams[name] for name in rig.streams if name in OWN}
    places: dict[str, tuple[str, int]] = {}
    for name, stream in own.items():
        host, _, port = stream.address.place.partition("?")[0].rpartition(":")
        places[name] = (host or "127.0.0.1", int(port))
    sensors = {name: stream.sensor for name, stream in own.items() if isinstance(stream.sensor, Live)}
    about = engine.about(options.model)
    several: list[Publisher] = []
    try:
        several.extend(publisher(address, about) for address in options.publish)
    except BaseException:
        for one in several:
            one.close()
        raise
    return Publishers(several, Own(places, sensors) if own else None, about.kind)


def check(address: str) -> tuple[str, str]:
    """Return scheme and place of an address. Raises `UsageError` for one that nothing can be published to."""
    scheme, colon, place = address.partition(":")
    if scheme not in EXAMPLES or not colon or not place:
        raise UsageError(
            f"--publish {excerpt(address)} is not an address; it should read like one of these: "
            f"{'; '.join(EXAMPLES.values())}."
        )
    return scheme, place


def publisher(address: str, about: About) -> Publisher:
    """Return the publisher of an address. Raises `UsageError` and `DeviceError`, as `opened`."""
    scheme, place = check(address)
    made: dict[str, Callable[[str, About], Any]] = {
        "ws": _websocket,
        "udp": _udp,
        "lsl": _lsl,
        "mcap": _mcap,
    }
    found: Publisher = made[scheme](place, about)
    return found


def _websocket(place: str, about: About) -> Publisher:
    with extras.named("--publish ws"):
        from tacpipe.live.publishers.websocket import WebsocketPublisher

    return WebsocketPublisher(place, about)


def _udp(place: str, about: About) -> Publisher:
    from tacpipe.live.publishers.udp import UdpPublisher

    return UdpPublisher(place, about)


def _lsl(place: str, about: About) -> Publisher:
    from tacpipe.live.publishers.lsl import LslPublisher

    return LslPublisher(place, about)


def _mcap(place: str, about: About) -> Publisher:
    from tacpipe.live.publishers.mcap import McapPublisher

    return McapPublisher(place, about)
