"""Publish messages to the session's own streams and to subscribers, without ever waiting for readers."""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self
from urllib.parse import parse_qsl

from tacpipe.errors import DeviceError, UsageError
from tacpipe.io import JsonObject
from tacpipe.links import lsl, network
from tacpipe.live.messages import Description, Message, packets, to_json
from tacpipe.live.settings import SessionOptions
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
DESCRIBED_EVERY = 100  # number of messages between descriptions, which are repeated because datagrams may be lost
MAX_DATAGRAM_BYTES = 65_000  # bytes
FORMATS = ("json", "msgpack")
MCAP_QUEUED = 500  # maximum number of messages waiting for the disk: 10 s at 50 Hz


class Publisher(Protocol):
    """Sends messages to one address without waiting for readers."""

    dropped: int  # number of messages not sent, over all subscribers

    def publish(self, message: Message) -> None:
        """Send a message, or drop it."""

    def close(self) -> None:
        """Send pending messages and close."""


class StreamPublisher:
    """The packets that the recording process reads as streams of the rig."""

    def __init__(self, addresses: Mapping[str, tuple[str, int]], sensors: Mapping[str, Live]) -> None:
        self.dropped = 0
        self._addresses, self._sensors = addresses, sensors
        self._sent = dict.fromkeys(sensors, 0)  # number of packets sent per stream
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def publish(self, message: Message) -> None:
        """Send the packets of a message."""
        for output, sensor in self._sensors.items():
            for packet in packets(message, sensor, self._sent[output]):
                self._sent[output] = (self._sent[output] + 1) % (1 << 32)
                try:
                    self._socket.sendto(packet, self._addresses[output])
                except OSError:
                    self.dropped += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Publishers:
    """All publishers of a session. The session's own streams come last, so that their latency covers the others."""

    def __init__(self, subscribed: list[Publisher], streams: StreamPublisher | None, about: Description) -> None:
        self.about = about
        self._subscribed = subscribed
        self._streams = streams
        self.states: Mapping[str, str] = {}  # the latest message as text

    @property
    def _publishers(self) -> list[Publisher]:
        return [*self._subscribed, *([] if self._streams is None else [self._streams])]

    @property
    def dropped(self) -> int:
        """Number of messages not sent."""
        return sum(publisher.dropped for publisher in self._publishers)

    def publish(self, message: Message, stamp: Callable[[Message], None]) -> None:
        """Send a message to all subscribers and record it in the session's own streams.

        ``stamp`` writes the current time and latency into the message; it is called for both.
        """
        stamp(message)
        for subscriber in self._subscribed:
            subscriber.publish(message)
        stamp(message)
        if self._streams is not None:
            self._streams.publish(message)
        self.states = message.states

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for opened in self._publishers:
            with contextlib.suppress(OSError):
                opened.close()


def open_publishers(options: SessionOptions, about: Description) -> Publishers:
    """Return the publishers of a session whose messages ``about`` describes.

    Raises `UsageError` for an unsupported address, `DeviceError` for one in use.
    """
    rig = rigs.parse(options.rig)
    addresses: dict[str, tuple[str, int]] = {}
    sensors: dict[str, Live] = {}
    for name in options.own_streams:
        stream = rig.streams[name]
        assert isinstance(stream.sensor, Live)
        host, _, port = stream.address.target.partition("?")[0].rpartition(":")
        addresses[name], sensors[name] = (host or "127.0.0.1", int(port)), stream.sensor
    subscribers: list[Publisher] = []
    try:
        subscribers.extend(publisher(address, about) for address in options.settings.publish)
    except BaseException:
        for opened in subscribers:
            opened.close()
        raise
    return Publishers(subscribers, StreamPublisher(addresses, sensors) if sensors else None, about)


def publisher(address: str, about: Description) -> Publisher:
    """Return the publisher of an address. Raises `UsageError` and `DeviceError` as `open_publishers` does."""
    scheme, location = parse_publish_address(address)
    if scheme == "ws":
        with extras.explain_missing("--publish ws"):
            from tacpipe.live.websocket import WebsocketPublisher

        return WebsocketPublisher(location, about)
    if scheme == "udp":
        return UdpPublisher(location, about)
    return LslPublisher(location, about) if scheme == "lsl" else McapPublisher(location, about)


def parse_publish_address(address: str) -> tuple[str, str]:
    """Return scheme and location of an address. Raises `UsageError` if it is not supported."""
    scheme, colon, location = address.partition(":")
    if scheme not in EXAMPLES or not colon or not location:
        raise UsageError(
            f"--publish {excerpt(address)} is not an address; it should read like one of these: "
            f"{'; '.join(EXAMPLES.values())}."
        )
    return scheme, location


class LslPublisher:
    """Publishes to an LSL outlet, which drops the oldest unread messages instead of waiting for readers."""

    def __init__(self, name: str, about: Description) -> None:
        """Open an outlet of the Lab Streaming Layer. Raises `MissingModuleError` without pylsl."""
        with extras.explain_missing("--publish lsl"):
            import pylsl
        lsl.silence_logging(pylsl)
        columns = about.columns()
        info = pylsl.StreamInfo(
            name, about.kind.capitalize(), len(columns), about.rate_hz, pylsl.cf_float32, f"tacpipe-{name}"
        )
        channels = info.desc().append_child("channels")
        for column, unit in columns:
            channel = channels.append_child("channel")
            channel.append_child_value("label", column)
            channel.append_child_value("unit", unit)
        self.dropped = 0
        self._about = about
        self._outlet = pylsl.StreamOutlet(info, max_buffered=2)

    def publish(self, message: Message) -> None:
        """Push a message; missing numbers are NaN."""
        self._outlet.push_sample(message.numbers(self._about))

    def close(self) -> None:
        """Close the outlet."""
        del self._outlet


class McapPublisher:
    """Writes a new MCAP file."""

    def __init__(self, file_name: str, about: Description) -> None:
        """Create a file, and write it in a thread. Raises `UsageError` if it exists or cannot be created."""
        with extras.explain_missing("--publish mcap"):
            from mcap.writer import Writer

        path = Path(file_name)
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise UsageError(f"--publish mcap:{file_name}: the file exists already; give another name.") from None
        except OSError as error:
            raise UsageError(f"--publish mcap:{file_name}: {error.strerror}.") from error
        self.dropped = 0
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="tacpipe")
        described = {"type": "object", "properties": about.schema()}
        schema = self._writer.register_schema(
            f"tacpipe.{about.kind.capitalize()}", "jsonschema", json.dumps(described).encode()
        )
        self._about_topic, self._topic = (
            self._writer.register_channel(f"/{name}", "json", schema) for name in ("description", about.kind)
        )
        self._about: bytes | None = to_json(about.to_dict())
        self._waiting: queue.Queue[tuple[int, Message] | None] = queue.Queue(MCAP_QUEUED)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def publish(self, message: Message) -> None:
        """Queue a message for writing, or drop it if the disk is too slow."""
        try:
            self._waiting.put_nowait((message.t_ns, message))
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write pending messages, and finish the file."""
        self._waiting.put(None)
        self._thread.join()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def _write(self) -> None:
        """Write queued messages, with the description before the first, until None arrives."""
        while (entry := self._waiting.get()) is not None:
            t_ns, message = entry
            if self._about is not None:
                self._writer.add_message(self._about_topic, t_ns, self._about, t_ns)
                self._about = None
            self._writer.add_message(self._topic, t_ns, to_json(message.to_dict()), t_ns)


class UdpPublisher:
    """Sends each message to one address."""

    def __init__(self, place: str, about: Description) -> None:
        """Open a socket to ``HOST:PORT``, with the option ``?format=msgpack``.

        Raises `UsageError` for another option, `DeviceError` if the address cannot be reached.
        """
        target, _, options = place.partition("?")
        parsed = dict(parse_qsl(options, keep_blank_values=True))
        kind = parsed.pop("format", "json")
        if parsed or kind not in FORMATS:
            raise UsageError(f"--publish udp:{target}?{excerpt(options)}: the only option is format, json or msgpack.")
        self.dropped = 0
        self._packed = to_json if kind == "json" else _msgpack()
        host, port = network.parse_host_port("udp", target)
        try:
            family, *_, address = socket.getaddrinfo(host or "127.0.0.1", port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.connect(address)
        except OSError as error:
            raise DeviceError(f"--publish udp:{target}: {error.strerror or error}.") from error
        self._socket.setblocking(False)
        self._about = self._packed(about.to_dict())
        self._until_about = 0

    def publish(self, message: Message) -> None:
        """Send a message, or drop it if the network does not accept it immediately."""
        if not self._until_about:
            self._until_about = DESCRIBED_EVERY
            self._send(self._about)
        self._until_about -= 1
        self._send(self._packed(message.to_dict()))

    def _send(self, data: bytes) -> None:
        """Send a datagram; count it as dropped if it is too large or the network does not accept it."""
        try:
            if len(data) > MAX_DATAGRAM_BYTES:
                raise OSError
            self._socket.send(data)
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _msgpack() -> Callable[[JsonObject], bytes]:
    """Return a function that encodes a message as msgpack. Raises `MissingModuleError` without that package."""
    with extras.explain_missing("--publish udp with format=msgpack"):
        import msgpack

    def encode(content: JsonObject) -> bytes:
        datagram: bytes = msgpack.packb(content)
        return datagram

    return encode
