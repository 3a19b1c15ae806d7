"""What UDP alone can tell: when the kernel got a datagram, and how many it had to drop."""

from __future__ import annotations

import socket
import time

import pytest

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import udp
from tacpipe.links.arrival import OLDEST_NS, Arrivals
from tests.links.peers import Listened, Quiet, made


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        number: int = port.getsockname()[1]
    return number


def test_a_datagram_is_stamped_when_it_came_and_not_when_it_was_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        port = free_port()
        link = made(f"udp::{port}", Quiet())
        before = time.monotonic_ns()
        device.sendto(b"one", ("127.0.0.1", port))
        between = time.monotonic_ns()
        time.sleep(0.1)
        device.sendto(b"two", ("127.0.0.1", port))
        time.sleep(0.1)
        found = link.read(1)
        link.close()

    (first, one), (second, two) = found
    slack = 20_000_000  # both clocks are not read at once
    assert (one, two) == (b"one", b"two")
    assert before - slack <= first <= between + slack
    assert second - first >= 100_000_000 - slack


def test_datagrams_that_the_kernel_drops_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "QUEUE", 4096)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        port = free_port()
        link = made(f"udp::{port}", Quiet())
        for number in range(200):
            device.sendto(number.to_bytes(2, "big"), ("127.0.0.1", port))
        early = link.read(1)
        device.sendto(b"last", ("127.0.0.1", port))  # the count travels on what comes after
        late = link.read(1)
        link.close()

    assert 0 < len(early) < 200
    assert late[-1][1] == b"last"
    assert link.overruns == 200 - len(early)


def test_a_listening_link_answers_whoever_spoke_last() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.settimeout(5)
        port = free_port()
        link = made(f"udp:127.0.0.1:{port}", Listened())
        assert link.local["port"] == port
        with pytest.raises(DeviceError, match="nobody can be answered; start the sender first"):
            link.write(b"hello?")
        device.sendto(b"state", ("127.0.0.1", port))
        link.read(1)
        link.write(b"answer")
        assert device.recv(100) == b"answer"
        link.close()


def test_a_port_that_is_taken_names_its_holder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacpipe.links.holders.os.getpid", lambda: -1)  # so that this process is another
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        with pytest.raises(DeviceError, match=rf"UDP port {port} is held by \S.* \(process \d+\); end it, or take"):
            made(f"udp::{port}", Quiet())


def test_an_address_of_another_computer_cannot_be_listened_on() -> None:
    with pytest.raises(DeviceError, match=r"192\.0\.2\.7 is no address of this computer; .+ udp::4010"):
        made("udp:192.0.2.7:4010", Listened())


@pytest.mark.parametrize("place", ["localhost", "localhost:", "localhost:70000", "localhost:x1"])
def test_a_port_that_is_none_is_refused(place: str) -> None:
    with pytest.raises(UsageError, match="names no port; it should read like udp:"):
        made(f"udp:{place}", Quiet())


def test_stamps_survive_a_wall_clock_that_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    arrivals = Arrivals()
    clocks = {"monotonic_ns": 1_000_000_000_000, "time_ns": 5_000_000_000_000}
    for name in clocks:
        monkeypatch.setattr(f"tacpipe.links.arrival.time.{name}", lambda name=name: clocks[name])

    arrivals.look()
    assert arrivals.of(clocks["time_ns"] - 3_000) == 999_999_997_000
    assert arrivals.of(clocks["time_ns"] + 10) == 1_000_000_000_000  # from the future: now
    clocks["time_ns"] += 2 * OLDEST_NS  # the clock is set forward while a datagram waits
    clocks["monotonic_ns"] += 500
    arrivals.look()
    assert arrivals.of(5_000_000_000_000) == 1_000_000_000_500
    assert arrivals.of(clocks["time_ns"] - 1_000) == 1_000_000_000_500  # never back
