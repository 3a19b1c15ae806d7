"""Test that a dialogue is executed, and that data that arrive meanwhile are not lost."""

import contextlib
import os
import pty
import queue
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tacpipe.errors import DeviceError
from tacpipe.links import opening as dialogue_of
from tacpipe.links.link import Arrived, Link
from tacpipe.links.opening import run_dialogue
from tacpipe.recording import rig
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.sensor import Ask, Dialogue
from tests.emulation.devices import device_for
from tests.links import peers
from tests.links.peers import SOON_S, Quiet, open_address
from tests.sensors.made import samples

Talk = Callable[[bytes, list[bytes]], None]
LEAST_S = 1.0  # a reply that is awaited for so long is to come; what is to be silent is awaited for less


@pytest.fixture
def device() -> Iterator[tuple[Link, Talk]]:
    """A link, and a way to have the device say something after it heard something."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = open_address(f"serial:{os.ttyname(slave)}", Quiet())
    exchanges: queue.Queue[tuple[bytes, list[bytes]]] = queue.Queue()
    stopped = threading.Event()

    def hears(after: bytes) -> bool:
        heard = b""
        while not heard.endswith(after) and not stopped.is_set():
            if select.select([master], [], [], 0.05)[0]:
                heard += os.read(master, 100)
        return not stopped.is_set()

    def run() -> None:  # one thread, for two would take what the other awaits
        while not stopped.is_set():
            with contextlib.suppress(queue.Empty):
                after, replies = exchanges.get(timeout=0.05)
                for reply in replies if hears(after) else []:
                    os.write(master, reply)

    def talk(after: bytes, replies: list[bytes]) -> None:
        exchanges.put((after, replies))

    thread = threading.Thread(target=run)
    thread.start()
    yield link, talk
    stopped.set()
    thread.join()
    link.close()
    os.close(slave)
    os.close(master)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Await a reply that is to come for as long as a busy computer may take; limits of their own are kept."""
    reply = dialogue_of._wait_for_reply

    def longer(link: Link, ask: Ask, *args: Any) -> Any:
        return reply(link, replace(ask, timeout_s=SOON_S) if ask.timeout_s >= LEAST_S else ask, *args)

    monkeypatch.setattr(dialogue_of, "_wait_for_reply", longer)


def until_all_came(link: Link, retained: Arrived, count: int) -> Arrived:
    """Return the retained packets and those that follow, ``count`` bytes in all."""
    packets, until = list(retained), time.monotonic() + SOON_S
    while sum(len(data) for _, data in packets) < count and time.monotonic() < until:
        packets += link.read(0.1)
    return packets


def ends_with_newline(data: bytes) -> int:
    return data.find(b"\n") + 1


def test_replies_reach_the_sensor_and_the_stream_behind_them_is_kept(device: tuple[Link, Talk]) -> None:
    link, talk = device
    heard = []

    def dialogue() -> Dialogue:
        heard.append((yield Ask(b"version?", ends_with_newline)))
        heard.append((yield Ask(b"", ends_with_newline)))  # a second line that nothing was asked for
        yield Ask(b"start", pause_s=0.2)

    talk(b"version?", [b"1.2\nserial 7\nfra", b"me"])
    talk(b"start", [b"frame2"])
    retained = run_dialogue(link, dialogue(), "probe")

    assert heard == [b"1.2\n", b"serial 7\n"]
    assert b"".join(data for _, data in until_all_came(link, retained, 11)) == b"frameframe2"
    assert [t_ns for t_ns, _ in retained] == sorted(t_ns for t_ns, _ in retained)


def marked(data: bytes) -> int | tuple[int, int]:
    start = data.find(b"<")
    stop = data.find(b">", start) + 1
    return (start, stop) if 0 <= start < stop else 0


def test_samples_before_and_after_a_reply_among_them_are_kept_with_their_arrivals(device: tuple[Link, Talk]) -> None:
    link, talk = device
    heard = []

    def dialogue() -> Dialogue:
        heard.append((yield Ask(b"tare", marked)))
        heard.append((yield Ask(b"", marked)))
        heard.append((yield Ask(b"", lambda data: (0, 0) if b"4" in data else 0)))  # it is there, and stays there

    arrived: list[tuple[int, bytes]] = []
    read = link.read

    def noted(timeout_s: float) -> list[tuple[int, bytes]]:
        packets = read(timeout_s)
        arrived.extend(packets)
        return packets

    link.read = noted  # type: ignore[method-assign]
    talk(b"tare", [b"sample1 sam", b"ple2 <do", b"ne>sample3 <ok>sample4 ", b"sample5 "])
    expected = b"sample1 sample2 sample3 sample4 sample5 "
    retained = until_all_came(link, run_dialogue(link, dialogue(), "probe"), len(expected))

    assert heard == [b"<done>", b"<ok>", b""]
    assert b"".join(data for _, data in retained) == expected
    stamps = {t_ns for t_ns, _ in arrived}
    assert {t_ns for t_ns, _ in retained[:2]} <= stamps and retained[0][0] == arrived[0][0]
    assert [t_ns for t_ns, _ in retained] == sorted(t_ns for t_ns, _ in retained)


@pytest.mark.parametrize("kind", ["paxini", "weiss-wts", "tfmini"])
def test_no_sample_is_lost_while_a_device_that_streams_is_opened_and_tared(
    kind: str, device: tuple[Link, Talk]
) -> None:
    link, talk = device
    sensor = rig.build_sensor(kind, {}, "stream")
    sent = iter(split_frames(sensor, sensor.encode(samples(kind, sensor, 40, seed=4))))
    end = device_for(sensor)
    end.streaming = True  # an earlier session left it so
    streamed_frames: list[bytes] = []

    def streamed() -> list[bytes]:
        frames = [next(sent) for _ in range(3 * end.streaming)]
        streamed_frames.extend(frames)
        return frames

    def dialogue() -> Dialogue:
        """Open and tare; while the device streams it sends frames before and behind each reply that is awaited."""
        for part in (sensor.opening({}), sensor.taring()):
            reply = None
            with contextlib.suppress(StopIteration):
                while True:
                    ask = next(part) if reply is None else part.send(reply)
                    before, replies = streamed(), end.hear(ask.send)
                    talk(ask.send, [b"".join([*before, *(replies if ask.until is not None else []), *streamed()])])
                    reply = yield ask

    retained = run_dialogue(link, dialogue(), "probe")
    retained = until_all_came(link, retained, len(b"".join(streamed_frames)))

    assert len(streamed_frames) > 5
    assert b"".join(data for _, data in retained) == b"".join(streamed_frames)


def test_packets_before_and_after_a_reply_are_no_replies() -> None:
    with peers.websocket() as peer:
        for text in (b"data 1", b"reply 1", b"data 2"):
            peer.send(text)

        def dialogue() -> Dialogue:
            reply = yield Ask(b"hello", lambda data: len(data) if data.startswith(b"reply") else 0)
            assert reply == b"reply 1"

        packets = run_dialogue(peer.link, dialogue(), "probe")
        if len(packets) < 2:  # Data behind the reply may come late
            packets += peer.receive(6)

    assert [data for _, data in packets] == [b"data 1", b"data 2"]


def test_a_control_connection_carries_the_dialogue_and_data_wait() -> None:
    with peers.tcp_and_udp() as peer:
        control = peer

        def dialogue() -> Dialogue:
            peer.send(b"datagram")
            yield Ask(b"connect")
            assert control.heard(7) == b"connect"

        assert run_dialogue(peer.link, dialogue(), "probe") == []
        assert peer.receive(8)[0][1] == b"datagram"


def test_silence_is_told_with_what_was_awaited(device: tuple[Link, Talk]) -> None:
    def dialogue() -> Dialogue:
        yield Ask(b"?", ends_with_newline, timeout_s=0.1, what="the version")

    with pytest.raises(DeviceError, match=r"0\.1 s"):
        run_dialogue(device[0], dialogue(), "pps")


def test_what_came_instead_of_a_reply_is_told(device: tuple[Link, Talk]) -> None:
    link, talk = device

    def dialogue() -> Dialogue:
        yield Ask(b"?", lambda data: (0, 0) if len(data) == 3 else 0)  # it has come
        yield Ask(b"", ends_with_newline, timeout_s=0.1, what="the version")

    talk(b"?", [b"\xaa\x55\x00"])
    with pytest.raises(DeviceError, match=r"3 other bytes.*55 00"):
        run_dialogue(link, dialogue(), "pps")


class Waiting:
    """A link at whose other end a reply waits to be read."""

    def __init__(self) -> None:
        self.pending: Arrived = [(1, b"1.2\n")]

    def write(self, data: bytes) -> None:
        pass

    def read(self, timeout_s: float) -> Arrived:
        packets, self.pending = self.pending, []
        return packets


def test_a_reply_that_waited_while_this_process_was_held_up_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = []

    def dialogue() -> Dialogue:
        heard.append((yield Ask(b"version?", ends_with_newline, timeout_s=0.1)))

    times_s = iter([0.0])
    monkeypatch.setattr(dialogue_of, "time", SimpleNamespace(monotonic=lambda: next(times_s, 5.0)))
    link: Any = Waiting()
    assert run_dialogue(link, dialogue(), "probe") == []
    assert heard == [b"1.2\n"]


def test_a_reply_that_means_no_ends_the_dialogue(device: tuple[Link, Talk]) -> None:
    link, talk = device

    def refused(data: bytes) -> int:
        raise DeviceError(f"The device says {data.decode()}.")

    def dialogue() -> Dialogue:
        yield Ask(b"start", refused)

    talk(b"start", [b"no"])
    with pytest.raises(DeviceError, match=r"The device says n"):
        run_dialogue(link, dialogue(), "pps")
