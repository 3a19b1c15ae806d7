"""No message that is older than its subscriber allows reaches it, and without a young message all is unknown."""

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import tacpipe
from tacpipe.live.messages import Message
from tacpipe.live.preparation import free_ports
from tacpipe.live.websocket import UNDERWAY, WebsocketPublisher
from tacpipe.sensors.live import OFF
from tacpipe.tasks.material.live.messages import FINAL, SLIDING, MaterialMessage
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tacpipe.tasks.touch.live.messages import TouchMessage
from tests.conftest import Lab
from tests.live.sessions import ended, started
from tests.live.test_publishers import free_port
from tests.recording import live, patient
from tests.recording.live import awaited

ABOUT = SlipDescription("models/slip", 98.0, 1.0, "1", {})
MINUTES_MS = 600_000
OFFSET_NS = Message.offset_ns  # from the monotonic clock of this process to that of the messages
SKIN = live.stream("skin", "xela", "ws:127.0.0.1:5000", "{ rate_hz = 50 }")


def slip(seq: int, age_ms: float = 0.0) -> SlipMessage:
    """Return an answer whose sample was measured some time ago and arrived 1 ms after that."""
    sampled_ns = time.monotonic_ns() + OFFSET_NS - round(age_ms * 1e6)
    return SlipMessage(seq, sampled_ns, 0.5, 0.5, OFF, made_from_t_ns=sampled_ns + 1_000_000)


@contextlib.contextmanager
def server(port: int | None = None) -> Iterator[tuple[WebsocketPublisher, str]]:
    """Yield a publisher with its address."""
    port = port or free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", ABOUT)
    try:
        yield publisher, f"ws://127.0.0.1:{port}"
    finally:
        publisher.close()


@contextlib.contextmanager
def pulling(address: str, max_age_ms: float = MINUTES_MS) -> Iterator[Callable[[int], dict[str, Any]]]:
    """Yield a function that asks with a clock and returns the next message of a client that asks for each."""
    from websockets.sync.client import connect

    with connect(f"{address}/?pull=1&max_age_ms={max_age_ms}") as client:
        assert json.loads(client.recv(60))["kind"] == "description"

        def ask(clock_ns: int) -> dict[str, Any]:
            client.send(str(clock_ns))
            return dict(json.loads(client.recv(60)))

        yield ask


def test_a_client_that_asks_gets_the_newest_message_and_the_number_of_those_that_it_missed() -> None:
    with server() as (publisher, address), pulling(address) as ask:
        for seq in range(1, 6):
            publisher.publish(slip(seq))
        newest = ask(0)
        assert (newest["seq"], newest["missed"]) == (5, 4) and publisher.dropped == 4
        threading.Timer(0.05, lambda: publisher.publish(slip(6))).start()
        following = ask(0)  # waits for it
        assert (following["seq"], following["missed"]) == (6, 4)


def test_a_message_that_is_older_than_the_request_allows_is_dropped_and_counted() -> None:
    with server() as (publisher, address), pulling(address, max_age_ms=60_000) as ask:
        publisher.publish(slip(1, age_ms=61_000))
        received: list[dict[str, Any]] = []
        asking = threading.Thread(target=lambda: received.append(ask(0)))
        asking.start()
        publisher.publish(slip(2, age_ms=61_000))
        publisher.publish(slip(3))
        asking.join(60)
        assert [(message["seq"], message["missed"]) for message in received] == [(3, 2)]


def test_messages_wait_for_no_subscriber_that_does_not_state_an_age() -> None:
    from websockets.sync.client import connect

    with server() as (publisher, address), connect(address) as client:
        awaited(lambda: publisher.subscribers == 1)
        publisher.publish(slip(1, age_ms=101))
        publisher.publish(SlipMessage(2, 5, cause="no sample comes from left"))  # about no sample: young when published
        assert [json.loads(client.recv(60))["kind"] for _ in range(2)] == ["description", "slip"]
        assert publisher.dropped == 1


@pytest.mark.parametrize("clock_ns", [0, 10**15, -(10**15)])
def test_a_client_with_another_clock_finds_its_offset_between_two_bounds(clock_ns: int) -> None:
    with server() as (publisher, address), pulling(address) as ask:
        publisher.publish(slip(1, age_ms=5))
        message = ask(time.monotonic_ns() + clock_ns)
        received_ns = time.monotonic_ns() + clock_ns
    offset_ns = OFFSET_NS - clock_ns
    assert message["sent_ns"] - received_ns <= offset_ns <= message["heard_ns"] - message["asked_ns"]
    assert message["sampled_ns"] < message["arrived_ns"] <= message["heard_ns"] <= message["sent_ns"]
    assert message["arrived_ns"] - message["sampled_ns"] == 1_000_000


@pytest.mark.parametrize("request_text", ["now", "1.5", ""])
def test_a_request_that_is_no_clock_ends_the_connection_and_the_others_continue(request_text: str) -> None:
    from websockets.exceptions import ConnectionClosedError
    from websockets.sync.client import connect

    with server() as (publisher, address), pulling(address) as ask:
        with connect(f"{address}/?pull=1") as client:
            client.recv(60)
            client.send(request_text)
            with pytest.raises(ConnectionClosedError, match="your clock in ns"):
                client.recv(60)
        publisher.publish(slip(1))
        assert ask(0)["seq"] == 1


@pytest.mark.parametrize("age", ["0", "-1", "nan", "soon"])
def test_an_age_that_is_not_above_0_is_refused(age: str) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with server() as (_, address), pytest.raises(InvalidStatus, match="400"), connect(f"{address}/?max_age_ms={age}"):
        pass
    if age != "soon":
        with pytest.raises(tacpipe.UsageError, match="max_age_ms"):
            tacpipe.subscribe(address, max_age_ms=float(age))


@pytest.mark.parametrize("address", ["127.0.0.1:8765", "http://127.0.0.1:8765", "ws:127.0.0.1:8765", ""])
def test_what_is_no_address_of_a_session_is_refused(address: str) -> None:
    with pytest.raises(tacpipe.UsageError, match="ws://127"):
        tacpipe.subscribe(address)


def test_many_requests_at_once_put_few_messages_on_their_way() -> None:
    from websockets.sync.client import connect

    with server() as (publisher, address), connect(f"{address}/?pull=1&max_age_ms={MINUTES_MS}") as client:
        client.recv(60)
        for number in range(50):
            client.send(str(number))
        awaited(lambda: all(subscriber.asked and subscriber.asked[0] == 49 for subscriber in publisher._subscribers))
        for seq in range(1, 51):
            publisher.publish(slip(seq))
        assert [json.loads(client.recv(60))["seq"] for _ in range(UNDERWAY)] == list(range(1, UNDERWAY + 1))
        client.send("50")
        assert json.loads(client.recv(60))["seq"] == 50


def test_a_subscriber_that_is_slow_gets_young_messages_and_knows_how_many_it_missed() -> None:
    over = threading.Event()
    with server() as (publisher, address), tacpipe.subscribe(address, max_age_ms=2000) as messages:

        def publish() -> None:
            seq = 0
            while not over.wait(0.002):
                seq += 1
                publisher.publish(slip(seq))

        awaited(lambda: publisher.subscribers == 1)
        publishing = threading.Thread(target=publish)
        publishing.start()
        received = []
        for message in messages:
            received += [message] if message["kind"] == "slip" else []
            if len(received) == 25:
                break
            time.sleep(0.02)  # ten times slower than the messages
        over.set()
        publishing.join()
    numbers = np.array([message["seq"] for message in received])
    missed = np.array([message["missed"] for message in received])
    assert (np.diff(numbers) > 1).any() and (np.diff(numbers) == 1 + np.diff(missed)).all()
    assert numbers[0] == missed[0] + 1
    # Not one waited for its client: it was sent after the request that it answers, and replaced all before.
    assert all(message["sent_ns"] - message["sampled_ns"] <= 2e9 and message["age_ms"] <= 2000 for message in received)
    assert all(message["sent_ns"] >= message["heard_ns"] for message in received)


def test_without_a_new_message_the_last_one_is_not_repeated() -> None:
    with server() as (publisher, address), tacpipe.subscribe(address, max_age_ms=300) as messages:
        awaited(lambda: publisher.subscribers == 1)

        def is_received() -> bool:
            publisher.publish(slip(1))
            return bool(next(messages)["kind"] == "slip")

        awaited(is_received)
        assert next(messages) == {"kind": "unknown", "cause": "no message came within 300 ms"}
        assert next(messages).get("alarm", "unknown") == "unknown"
        assert messages.description is not None and messages.description["model"] == "models/slip"


def test_a_subscription_outlives_its_session_and_is_unknown_without_one() -> None:
    port = free_port()
    with tacpipe.subscribe(f"ws://127.0.0.1:{port}/", max_age_ms=200) as messages:
        awaited(lambda: "not connected: " in next(messages)["cause"])
        for seq in (1, 2):  # two sessions, one after the other
            with server(port) as (publisher, _):

                def is_received(publisher: WebsocketPublisher = publisher, seq: int = seq) -> bool:
                    publisher.publish(slip(seq))
                    return bool(next(messages).get("seq") == seq)

                awaited(is_received)
            assert next(messages)["kind"] == "unknown"


def test_a_message_that_arrives_too_late_is_unknown() -> None:
    """The server believes that the message is young, as if the network held it back."""
    from websockets.sync.server import serve

    def answer(connection: Any) -> None:
        connection.send(json.dumps({"kind": "description"}))
        stamps: list[dict[str, int | None]] = [{"sampled_ns": 0, "sent_ns": 0}, {"sampled_ns": None, "sent_ns": 0}]
        for number, text in enumerate(connection):
            old = {"kind": "slip", "missed": 0, "asked_ns": int(text), "heard_ns": 10**9, **stamps[number % 2]}
            connection.send(json.dumps(old))

    with serve(answer, "127.0.0.1", 0) as fake_server:
        serving = threading.Thread(target=fake_server.serve_forever)
        serving.start()
        with tacpipe.subscribe(f"ws://127.0.0.1:{fake_server.socket.getsockname()[1]}", max_age_ms=900) as messages:
            assert {next(messages)["kind"] for _ in range(3)} == {"unknown"}
            assert messages.description is not None  # it was connected
        fake_server.shutdown()
        serving.join()


def test_the_answer_to_a_request_and_the_last_one_of_a_slide_are_about_no_moment() -> None:
    probabilities = np.array([0.25, 0.75], np.float32)
    sliding = MaterialMessage(1, 9, ("cork", "felt"), probabilities, SLIDING, made_from_t_ns=7)
    final = MaterialMessage(2, 9, ("cork", "felt"), probabilities, FINAL, made_from_t_ns=7)
    ranking = TouchMessage(1, 9, 1, "contact", np.zeros((1, 2)), ranks=(1,), made_from_t_ns=9)
    assert [message.sampled_ns for message in (sliding, final, ranking)] == [7, None, None]
    assert [message.arrived_ns for message in (sliding, final, ranking)] == [7, 7, 9]
    row = SlipMessage(1, 5, 0.5, made_from_t_ns=7)  # measured at 5, arrived at 7
    assert (row.sampled_ns, row.arrived_ns, SlipMessage(1, 5, made_from_t_ns=7).sampled_ns) == (5, 7, None)


@pytest.mark.rig
def test_a_slow_subscriber_of_a_session_gets_forecasts_that_are_young_and_in_order(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    patient.relax(monkeypatch)
    (port,) = free_ports(1)
    received: list[dict[str, Any]] = []
    with live.served(lab.folder, SKIN):
        process = started(lab, f"-o rec --json --publish ws:127.0.0.1:{port}")
        with tacpipe.subscribe(f"ws://127.0.0.1:{port}", max_age_ms=5000) as messages:
            for message in messages:
                received += [message] if message.get("values") is not None else []
                if len(received) == 15:
                    break
                time.sleep(0.1)  # five periods
        ended(process, interrupt=True)
    arrivals = set(live.only(lab.folder).table("skin").column("t_ns").to_pylist())
    assert {message["arrived_ns"] for message in received} <= arrivals
    for earlier, later in itertools.pairwise(received):
        assert earlier["sampled_ns"] < later["sampled_ns"] <= later["arrived_ns"] <= later["sent_ns"]
        assert later["seq"] - earlier["seq"] == 1 + later["missed"] - earlier["missed"]
        assert later["asked_ns"] > earlier["asked_ns"] and later["heard_ns"] >= earlier["sent_ns"]
