"""Subscribers get each message as it was published, and one that is slow costs nobody else anything."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import DeviceError, UsageError
from tacpipe.live import publishing
from tacpipe.live.material_messages import SLIDING, MaterialDescription, MaterialMessage
from tacpipe.live.messages import Description, Message
from tacpipe.live.publishers.udp import UdpPublisher
from tacpipe.live.publishers.websocket import BEHIND, QUEUED, WebsocketPublisher
from tests.recording.live import awaited

ABOUT = Description(("a", "b"), (1, 2), "count", 50.0, "models/forward")
VALUES = np.array([[1.5, -2.25], [3.0, 1e-3]], dtype=np.float32)


def message(seq: int, values: Any = VALUES) -> Message:
    return Message(seq, 10**18 + seq, values)


@pytest.fixture
def heard() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(60)
        yield one


@pytest.mark.parametrize("kind", ["json", "msgpack"])
def test_datagrams_hold_the_description_and_then_each_message(heard: socket.socket, kind: str) -> None:
    import msgpack

    read = json.loads if kind == "json" else msgpack.unpackb
    publisher = UdpPublisher(f"127.0.0.1:{heard.getsockname()[1]}?format={kind}", ABOUT)
    publisher.publish(message(1))
    publisher.publish(message(2, None))
    about, first, second = (read(heard.recv(1 << 16)) for _ in range(3))
    publisher.close()
    assert about == {
        **{"version": 1, "kind": "description", "channels": ["a", "b"], "steps": [1, 2]},
        **{"unit": "count", "rate_hz": 50.0, "model": "models/forward"},
    }
    assert np.array_equal(np.array(first["values"], dtype=np.float32), VALUES) and first["seq"] == 1
    assert second["values"] is None and second["alarms"]["slip"]["state"] == "unknown"


def test_nobody_who_listens_costs_nothing_but_a_count(heard: socket.socket) -> None:
    place = f"127.0.0.1:{heard.getsockname()[1]}"
    heard.close()
    publisher = UdpPublisher(place, ABOUT)
    for seq in range(5):
        publisher.publish(message(seq))
    assert publisher.dropped > 0
    publisher.close()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_each_websocket_client_gets_the_description_and_every_message() -> None:
    from websockets.sync.client import connect

    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
    with connect(f"ws://127.0.0.1:{port}") as one, connect(f"ws://127.0.0.1:{port}") as other:
        awaited(lambda: publisher.subscribers == 2)
        for seq in range(5):
            publisher.publish(message(seq))
        for client in (one, other):
            found = [json.loads(client.recv(60)) for _ in range(6)]
            assert found[0]["channels"] == ["a", "b"] and [each["seq"] for each in found[1:]] == list(range(5))
            assert np.array_equal(np.array(found[3]["values"], dtype=np.float32), VALUES)
    publisher.close()


def test_a_client_that_does_not_read_is_cut_off_and_others_get_everything() -> None:
    from websockets.sync.client import connect

    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
    large = np.zeros((200, 400), dtype=np.float32)
    count = BEHIND + QUEUED + 60
    slow = socket.create_connection(("127.0.0.1", port))
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    slow.sendall(f"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{key}\r\n".encode())
    awaited(lambda: publisher.subscribers == 1)
    with connect(f"ws://127.0.0.1:{port}", max_size=None) as quick:
        awaited(lambda: publisher.subscribers == 2)
        quick.recv(60)
        found: list[int] = []
        read = threading.Event()

        def keep_up() -> None:
            for _ in range(count):
                found.append(json.loads(quick.recv(60))["seq"])
                read.set()

        reader = threading.Thread(target=keep_up)
        reader.start()
        for seq in range(count):
            read.clear()
            publisher.publish(message(seq, large))
            assert read.wait(60)  # the quick one has it, whatever the slow one does
        reader.join(60)
    assert found == list(range(count)) and publisher.dropped >= BEHIND
    assert publisher.subscribers <= 1  # the quick one has gone too, which shows with the next message
    publisher.publish(message(count))
    awaited(lambda: publisher.subscribers == 0)
    slow.close()
    publisher.close()


def test_an_mcap_file_holds_each_message_at_its_time(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "session.mcap"
    publisher = publishing.publisher(f"mcap:{path}", ABOUT)
    for seq in range(3):
        publisher.publish(message(seq))
    publisher.close()
    with path.open("rb") as file:
        found = [
            (channel.topic, one.log_time, json.loads(one.data)) for _, channel, one in make_reader(file).iter_messages()
        ]
    assert sorted(topic for topic, _, _ in found) == ["/description", *["/forecast"] * 3]
    for topic, t_ns, content in found:
        if topic == "/forecast":
            assert t_ns == content["t_ns"] == 10**18 + content["seq"]
            assert np.array_equal(np.array(content["values"], dtype=np.float32), VALUES)
    with pytest.raises(UsageError, match=r"session\.mcap"):
        publishing.publisher(f"mcap:{path}", ABOUT)


@pytest.mark.parametrize(
    "address", ["ws", "ws:", "http:127.0.0.1:80", "udp:127.0.0.1", "udp:127.0.0.1:9?format=xml", "ws:127.0.0.1:0", ""]
)
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError):
        publishing.publisher(address, ABOUT)


def test_a_port_that_is_taken_is_refused_with_its_address() -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        port = one.getsockname()[1]
        with pytest.raises(DeviceError, match=str(port)):
            publishing.publisher(f"ws:127.0.0.1:{port}", ABOUT)


def test_an_mcap_file_of_materials_has_a_topic_and_a_schema_of_its_own(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "session.mcap"
    about = MaterialDescription(("cork", "felt"), "biotac", 100, True, "order", 10.0, "models/material")
    publisher = publishing.publisher(f"mcap:{path}", about)
    publisher.publish(MaterialMessage(1, 7, ("cork", "felt"), np.array([0.25, 0.75], np.float32), SLIDING, 50, 0.5))
    publisher.close()
    with path.open("rb") as file:
        found = [
            (schema, channel.topic, json.loads(one.data)) for schema, channel, one in make_reader(file).iter_messages()
        ]
    assert [topic for _, topic, _ in found] == ["/description", "/material"]
    schema, _, content = found[1]
    assert schema is not None and schema.name == "tacpipe.Material"
    assert set(content) == set(json.loads(schema.data)["properties"])
    assert content["material"] == "felt" and content["probabilities"] == {"cork": 0.25, "felt": 0.75}
