"""Properties that only UDP has: the kernel's stamp of each datagram and the number of those it dropped."""

import itertools
import os
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import network
from tacpipe.links.link import MAX_AGE_NS, Arrivals, LinkLostError
from tests.links import peers
from tests.links.peers import Listened, Quiet, open_address

SENT = [b"one", b"two", b"three"]
WALL_NS = 1_700_000_000_000_000_000  # Lead of the wall clock over the monotonic clock


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        number: int = port.getsockname()[1]
    return number


@pytest.fixture
def stamping() -> Iterator[None]:
    """A kernel that stamps what arrives: it begins to some time after the first socket asks, later where it is busy."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.SOL_SOCKET, network.STAMPS, 1)
        asking.bind(("127.0.0.1", 0))
        late = True
        while late:
            asking.sendto(b"", asking.getsockname())
            time.sleep(0.01)
            read_s = time.time()
            _, ((_, _, stamp),), _, _ = asking.recvmsg(1, network.ANCILLARY_BYTES)
            seconds, nanoseconds = struct.unpack("@ll", stamp)
            late = seconds + nanoseconds / 1e9 > read_s
        yield


@pytest.mark.rig
@pytest.mark.usefixtures("stamping")
def test_a_datagram_is_stamped_when_it_came_and_not_when_it_was_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        port = free_port()
        link = open_address(f"udp::{port}", Quiet())
        before = time.monotonic_ns()
        device.sendto(b"one", ("127.0.0.1", port))
        between = time.monotonic_ns()
        time.sleep(0.1)
        device.sendto(b"two", ("127.0.0.1", port))
        time.sleep(0.1)
        datagrams = link.read(1)
        link.close()

    (first, first_data), (second, second_data) = datagrams
    slack = 20_000_000  # both clocks are not read at once
    assert (first_data, second_data) == (b"one", b"two")
    assert before - slack <= first <= between + slack
    assert second - first >= 100_000_000 - slack


def test_datagrams_that_the_kernel_drops_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "QUEUE_BYTES", 4096)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        port = free_port()
        link = open_address(f"udp::{port}", Quiet())
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
        link = open_address(f"udp:127.0.0.1:{port}", Listened())
        assert link.local["port"] == port
        with pytest.raises(DeviceError, match="udp"):
            link.write(b"hello?")
        device.sendto(b"state", ("127.0.0.1", port))
        link.read(1)
        link.write(b"answer")
        assert device.recv(100) == b"answer"
        link.close()


def test_a_port_that_is_taken_names_its_holder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getpid", lambda: -1)  # This process then counts as another one
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("0.0.0.0", 0))
        port = holder.getsockname()[1]
        with pytest.raises(DeviceError, match=rf"UDP port {port}.*\S"):
            open_address(f"udp::{port}", Quiet())


def test_an_address_of_another_computer_cannot_be_listened_on() -> None:
    with pytest.raises(DeviceError, match=r"192\.0\.2\.7.*udp::4010"):
        open_address("udp:192.0.2.7:4010", Listened())


@pytest.mark.parametrize("place", ["localhost", "localhost:", "localhost:70000", "localhost:x1"])
def test_a_port_that_is_none_is_refused(place: str) -> None:
    with pytest.raises(UsageError, match="udp:"):
        open_address(f"udp:{place}", Quiet())


def test_stamps_survive_a_wall_clock_that_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    arrivals = Arrivals()
    clocks = {"monotonic_ns": 1_000_000_000_000, "time_ns": 5_000_000_000_000}
    for name in clocks:
        monkeypatch.setattr(f"tacpipe.links.link.time.{name}", lambda name=name: clocks[name])

    arrivals.read_clocks()
    assert arrivals.to_monotonic(clocks["time_ns"] - 3_000) == 999_999_997_000
    assert arrivals.to_monotonic(clocks["time_ns"] + 10) == 1_000_000_000_000  # A stamp from the future becomes now
    clocks["time_ns"] += 2 * MAX_AGE_NS  # the clock is set forward while a datagram waits
    clocks["monotonic_ns"] += 500
    arrivals.read_clocks()
    assert arrivals.to_monotonic(5_000_000_000_000) == 1_000_000_000_500
    assert (
        arrivals.to_monotonic(clocks["time_ns"] - 1_000) == 1_000_000_000_501
    )  # never back, and after what it came after


class Clocks:
    """Both clocks, between two readings of which time passes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, passing: Iterator[int]) -> None:
        self.now_ns, self.passing = 1_000_000_000, passing
        monkeypatch.setattr("tacpipe.links.link.time", self)

    def monotonic_ns(self) -> int:
        """Return the time since the computer started."""
        self.now_ns += next(self.passing)
        return self.now_ns

    def time_ns(self) -> int:
        """Return what the clock on the wall says."""
        return self.monotonic_ns() + WALL_NS


class Flooded(socket.socket):
    """A port at which a datagram arrives whenever it is looked for one, until there are no more."""

    clocks: Clocks
    queued = 50

    def recvmsg(self, *_: int) -> Any:
        """Return a datagram with the stamp of its arrival, which is now."""
        if not self.queued:
            raise BlockingIOError
        self.queued -= 1
        self.clocks.now_ns += 700
        stamp = struct.pack("@ll", *divmod(self.clocks.now_ns + WALL_NS, 1_000_000_000))
        return str(self.clocks.now_ns).encode(), [(socket.SOL_SOCKET, network.STAMPS, stamp)], 0, None


def test_datagrams_that_come_while_others_are_fetched_bear_their_own_arrivals(monkeypatch: pytest.MonkeyPatch) -> None:
    with Flooded(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.clocks = Clocks(monkeypatch, itertools.repeat(0))
        link = network.UdpLink("flood", port, prompt=True)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
            port.bind(("127.0.0.1", 0))
            device.sendto(b"", port.getsockname())  # The datagram makes the port ready
        datagrams = link.read(peers.SOON_S)
        link.close()

    assert [t_ns for t_ns, _ in datagrams] == [int(data) for _, data in datagrams]


@given(
    batches=st.lists(st.lists(st.integers(0, 2_000), min_size=1, max_size=8), min_size=1, max_size=8),
    passing=st.lists(st.integers(1, 400_000), min_size=60, max_size=60),
)
def test_stamps_are_as_far_apart_as_the_kernel_s_and_equal_only_where_those_are(
    batches: list[list[int]], passing: list[int]
) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        clocks = Clocks(monkeypatch, itertools.cycle(passing))
        arrivals = Arrivals()
        mapped, true = [], []
        for batch in batches:
            moments = []
            for apart_ns in batch:
                clocks.now_ns += apart_ns
                moments.append(clocks.now_ns)
            arrivals.read_clocks()
            mapped += [arrivals.to_monotonic(t_ns + WALL_NS) for t_ns in moments]
            true += moments

    assert [later > earlier for earlier, later in itertools.pairwise(mapped)] == [
        later > earlier for earlier, later in itertools.pairwise(true)
    ]
    assert max(abs(stamp - moment) for stamp, moment in zip(mapped, true, strict=True)) <= 2 * max(passing) + len(true)


def test_datagrams_that_came_before_the_control_connection_closed_are_given_out_first() -> None:
    with peers.tcp_and_udp() as peer:
        for data in SENT:
            peer.send(data)
        peer.leave()
        datagrams = peer.link.read(peers.SOON_S)
        with pytest.raises(LinkLostError, match="probe"):
            peer.link.read(0)

    assert [data for _, data in datagrams] == SENT


def test_datagrams_that_came_before_the_port_refused_are_given_out_first() -> None:
    with peers.udp_talking() as peer:
        peer.link.write(b"hello")
        assert peer.heard(5) == b"hello"
        for data in SENT:
            peer.send(data)
        peer.leave()
        datagrams = peer.link.read(peers.SOON_S)
        with pytest.raises(LinkLostError, match="probe"):
            peer.link.read(0)

    assert [data for _, data in datagrams] == SENT


class Crowd(socket.socket):
    """A port at which several hosts send: three datagrams of each, in turn."""

    queued: list[tuple[str, bytes]]

    def recvmsg(self, *_: int) -> Any:
        """Return the next datagram, and whose it is."""
        if not self.queued:
            raise BlockingIOError
        host, data = self.queued.pop(0)
        return data, [], 0, (host, 4010)


@pytest.mark.parametrize(
    ("sender", "hosts", "foreign"),
    [("", "abab", 0), ("first", "aa", 2), ("192.0.2.1", "aa", 2), ("192.0.2.2", "bb", 2), ("192.0.2.3", "", 4)],
)
def test_a_declared_sender_alone_is_read_and_others_are_counted(sender: str, hosts: str, foreign: int) -> None:
    names = {"a": "192.0.2.1", "b": "192.0.2.2"}
    with Crowd(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.queued = [(names[host], host.encode()) for host in "abab"]
        link = network.UdpLink("crowd", port, prompt=True, sender=sender)
        datagrams = link._read_queue()

        assert b"".join(data for _, data in datagrams).decode() == hosts
        assert link.foreign == foreign
        link.close()


def test_a_flood_is_left_to_the_next_read() -> None:
    with Crowd(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.queued = [("192.0.2.1", b"x")] * (network.MAX_FETCHED + 10)
        link = network.UdpLink("flood", port, prompt=True)

        assert [len(link._read_queue()), len(link._read_queue())] == [network.MAX_FETCHED, 10]
        link.close()


@pytest.mark.parametrize(
    "option", ["sender=", "sender=host", "sender=1.2.3", "first", "port=4010", "sender=1.2.3.4:80"]
)
def test_a_sender_that_is_no_address_is_refused(option: str) -> None:
    with pytest.raises(UsageError, match=r"\?sender=192\.168\.1\.20.*\?sender=first"):
        open_address(f"udp::{free_port()}?{option}", Quiet())


def test_a_sender_beside_a_host_is_refused() -> None:
    with pytest.raises(UsageError, match=r"127\.0\.0\.1.*\?sender=first"):
        open_address("udp:127.0.0.1:4010?sender=first", Quiet())


def test_an_address_with_a_sender_listens_as_one_without() -> None:
    port = free_port()
    link = open_address(f"udp::{port}?sender=127.0.0.1", Quiet())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.sendto(b"one", ("127.0.0.1", port))

    assert [data for _, data in link.read(peers.SOON_S)] == [b"one"] and link.foreign == 0
    link.close()
