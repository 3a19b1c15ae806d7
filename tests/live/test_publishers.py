"""Subscribers get each message as it was published, and one that is slow costs nobody else anything."""

import asyncio
import contextlib
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
from tacpipe.live.publishing import UdpPublisher
from tacpipe.live.websocket import CONNECTIONS, TOKEN, UNDERWAY, WebsocketPublisher
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage
from tacpipe.tasks.material.live.messages import SLIDING, MaterialDescription, MaterialMessage
from tests.recording.live import awaited

ABOUT = ForecastDescription(("a", "b"), (1, 2), "count", 50.0, "models/forward")
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
VALUES = np.array([[1.5, -2.25], [3.0, 1e-3]], dtype=np.float32)


def message(seq: int, values: Any = VALUES) -> ForecastMessage:
    return ForecastMessage(seq, 10**18 + seq, values)


@pytest.fixture
def heard() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        yield receiver


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
        **{"version": 1, "kind": "description", "of": "forecast", "channels": ["a", "b"], "steps": [1, 2]},
        **{"unit": "count", "rate_hz": 50.0, "model": "models/forward"},
    }
    assert np.array_equal(np.array(first["values"], dtype=np.float32), VALUES) and first["seq"] == 1
    assert second["values"] is None


def test_nobody_who_listens_costs_nothing_but_a_count(heard: socket.socket) -> None:
    place = f"127.0.0.1:{heard.getsockname()[1]}"
    heard.close()
    publisher = UdpPublisher(place, ABOUT)
    for seq in range(5):
        publisher.publish(message(seq))
    assert publisher.dropped > 0
    publisher.close()


def free_port() -> int:
    with socket.socket() as free_socket:
        free_socket.bind(("127.0.0.1", 0))
        return int(free_socket.getsockname()[1])


@pytest.fixture
def served() -> Iterator[tuple[WebsocketPublisher, int]]:
    """Yield a publisher and its port on this computer."""
    port = free_port()
    publisher = WebsocketPublisher(f":{port}", ABOUT)
    yield publisher, port
    publisher.close()


@contextlib.contextmanager
def subscribe(port: int, query: str = "", **options: Any) -> Iterator[Any]:
    """Yield a client whose first message has come."""
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}/{query}", **options) as client:
        assert json.loads(client.recv(60))["channels"] == ["a", "b"]
        yield client


def ended_by_server(connection: socket.socket) -> bool:
    """Wait until the server ends a connection; what it sends before is read."""
    connection.settimeout(60)
    with contextlib.suppress(ConnectionError):
        while connection.recv(1 << 16):
            pass
    return True


def test_a_server_without_a_host_is_reached_from_this_computer_only(served: tuple[WebsocketPublisher, int]) -> None:
    _, port = served
    with subscribe(port):
        pass
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port))  # every other address of this computer


def test_connections_beyond_the_limit_are_ended_and_neither_threads_nor_messages_depend_on_their_number(
    served: tuple[WebsocketPublisher, int],
) -> None:
    publisher, port = served
    with subscribe(port) as client, contextlib.ExitStack() as opened:
        threads = threading.active_count()
        connections = [opened.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(100)]
        assert all(ended_by_server(connection) for connection in connections[CONNECTIONS:])
        assert threading.active_count() == threads
        publisher.publish(message(1))
        assert json.loads(client.recv(60))["seq"] == 1
    awaited(lambda: publisher.subscribers == 0)


@pytest.mark.parametrize(
    "sent", [b"\x81\xff" + (900_000).to_bytes(8, "big") + bytes(900_004), b"\x89\x80\0\0\0\0" * 50_000]
)
def test_a_client_that_sends_more_than_a_subscriber_needs_is_ended(
    served: tuple[WebsocketPublisher, int], sent: bytes
) -> None:
    publisher, port = served
    with subscribe(port) as quiet, socket.create_connection(("127.0.0.1", port)) as loud:
        loud.sendall(HANDSHAKE)
        awaited(lambda: publisher.subscribers == 2)
        with contextlib.suppress(ConnectionError):
            loud.sendall(sent)
        assert ended_by_server(loud)
        awaited(lambda: publisher.subscribers == 1)
        publisher.publish(message(1))
        assert json.loads(quiet.recv(60))["seq"] == 1


def test_a_closed_server_leaves_no_task_of_clients_that_never_sent_their_request() -> None:
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
    loop = publisher._loop
    with contextlib.ExitStack() as opened:
        for _ in range(CONNECTIONS):
            opened.enter_context(socket.create_connection(("127.0.0.1", port)))
        awaited(lambda: len(publisher._connections) == CONNECTIONS)
        publisher.close()
        assert not asyncio.all_tasks(loop) and loop.is_closed()


def test_a_web_page_is_refused_unless_the_address_lists_its_origin() -> None:
    from websockets.exceptions import InvalidStatus

    port = free_port()
    publisher = WebsocketPublisher(f":{port}?origin=http://localhost:3000", ABOUT)
    with subscribe(port):
        pass
    for origin in (
        "http://localhost:3000",
        f"http://127.0.0.1:{port}",
    ):  # the second is that of the publisher's own page
        with subscribe(port, origin=origin):
            pass
    for origin in ("http://evil.example", f"http://evil.example:{port}", "http://127.0.0.1:1", "null"):
        with pytest.raises(InvalidStatus, match="403"), subscribe(port, origin=origin):
            pass
    publisher.close()


def test_with_a_token_in_the_environment_only_clients_that_send_it_subscribe(monkeypatch: pytest.MonkeyPatch) -> None:
    from websockets.exceptions import InvalidStatus

    port = free_port()
    monkeypatch.setenv(TOKEN, "open sesame")
    publisher = WebsocketPublisher(f":{port}", ABOUT)
    with subscribe(port, "?token=open%20sesame"):
        pass
    with subscribe(port, additional_headers={"Authorization": "Bearer open sesame"}):
        pass
    for query, headers in (("", {}), ("?token=", {}), ("?token=sesame", {}), ("", {"Authorization": "Bearer x"})):
        with pytest.raises(InvalidStatus, match="401"), subscribe(port, query, additional_headers=headers):
            pass
    publisher.close()


def test_each_websocket_client_gets_the_description_and_every_message() -> None:
    from websockets.sync.client import connect

    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
    with connect(f"ws://127.0.0.1:{port}") as first_client, connect(f"ws://127.0.0.1:{port}") as second_client:
        awaited(lambda: publisher.subscribers == 2)
        for seq in range(5):
            publisher.publish(message(seq))
        for client in (first_client, second_client):
            received = [json.loads(client.recv(60)) for _ in range(6)]
            assert received[0]["channels"] == ["a", "b"] and [content["seq"] for content in received[1:]] == list(
                range(5)
            )
            assert np.array_equal(np.array(received[3]["values"], dtype=np.float32), VALUES)
    publisher.close()


def test_a_client_that_does_not_read_gets_few_messages_and_others_get_everything(
    served: tuple[WebsocketPublisher, int],
) -> None:
    publisher, port = served
    large = np.zeros((20, 400), dtype=np.float32)
    count = UNDERWAY + 60
    with socket.create_connection(("127.0.0.1", port)) as slow, subscribe(port, "?max_age_ms=600000") as quick:
        slow.sendall(HANDSHAKE)
        awaited(lambda: publisher.subscribers == 2)
        for seq in range(count):
            publisher.publish(message(seq, large))
            assert json.loads(quick.recv(60))["seq"] == seq
        assert publisher.dropped == count - UNDERWAY - 1  # the last one is not replaced yet
        slow.shutdown(socket.SHUT_WR)
        received = b"".join(iter(lambda: slow.recv(1 << 16), b""))
    assert received.count(b'"seq":') == UNDERWAY


def test_an_mcap_file_holds_each_message_at_its_time(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "session.mcap"
    publisher = publishing.publisher(f"mcap:{path}", ABOUT)
    for seq in range(3):
        publisher.publish(message(seq))
    publisher.close()
    with path.open("rb") as file:
        records = [
            (channel.topic, record.log_time, json.loads(record.data))
            for _, channel, record in make_reader(file).iter_messages()
        ]
    assert sorted(topic for topic, _, _ in records) == ["/description", *["/forecast"] * 3]
    for topic, t_ns, content in records:
        if topic == "/forecast":
            assert t_ns == content["t_ns"] == 10**18 + content["seq"]
            assert np.array_equal(np.array(content["values"], dtype=np.float32), VALUES)
    with pytest.raises(UsageError, match=r"session\.mcap"):
        publishing.publisher(f"mcap:{path}", ABOUT)


@pytest.mark.parametrize(
    "address",
    [
        "ws",
        "ws:",
        "http:127.0.0.1:80",
        "udp:127.0.0.1",
        "udp:127.0.0.1:9?format=xml",
        "ws:127.0.0.1:0",
        "ws::9?token=x",
        "",
    ],
)
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError):
        publishing.publisher(address, ABOUT)


def test_a_port_that_is_taken_is_refused_with_its_address() -> None:
    with socket.socket() as taken_socket:
        taken_socket.bind(("127.0.0.1", 0))
        taken_socket.listen()
        port = taken_socket.getsockname()[1]
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
        records = [
            (schema, channel.topic, json.loads(record.data))
            for schema, channel, record in make_reader(file).iter_messages()
        ]
    assert [topic for _, topic, _ in records] == ["/description", "/material"]
    schema, _, content = records[1]
    assert schema is not None and schema.name == "tacpipe.Material"
    assert set(content) == set(json.loads(schema.data)["properties"])
    assert content["material"] == "felt" and content["probabilities"] == {"cork": 0.25, "felt": 0.75}
