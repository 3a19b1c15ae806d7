"""Test that a link that cannot be opened raises one sentence with the device, the fault and a remedy."""

import errno
import os
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import can
from tacpipe.links.link import SCHEMES, parse
from tacpipe.links.opening import OPENERS
from tests.links.peers import Quiet, open_address


@pytest.fixture
def closed_port() -> int:
    """A TCP port on which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port


@pytest.fixture
def rude_port() -> Iterator[int]:
    """A TCP port on which someone listens who speaks no websocket."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(b"220 printer ready\r\n")

        thread = threading.Thread(target=hang_up)
        thread.start()
        yield server.getsockname()[1]
        thread.join()


def test_every_kind_of_address_has_an_opener() -> None:
    assert set(OPENERS) == set(SCHEMES)


@pytest.mark.parametrize("scheme", ["tcp", "tcp+udp", "ws"])
def test_a_port_that_nobody_serves_is_refused(scheme: str, closed_port: int) -> None:
    message = rf"^Stream probe \(.+\): 127\.0\.0\.1 is reachable, but refuses port {closed_port}; start the program"
    with pytest.raises(DeviceError, match=message):
        open_address(f"{scheme}:127.0.0.1:{closed_port}", Quiet())


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (socket.gaierror(-2, "Name or service not known"), "the host arm.lab is not known; check its name"),
        (TimeoutError(), "arm.lab did not respond on port 7 within 5 s; check that it is switched on"),
        (
            OSError(errno.EHOSTUNREACH, "No route to host"),
            "arm.lab cannot be reached from this computer; check the cable",
        ),
        (OSError(errno.ENETUNREACH, "Unreachable"), "arm.lab cannot be reached from this computer; check the cable"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "arm.lab port 7 cannot be opened: Too many open files."),
    ],
)
def test_what_the_network_answers_becomes_a_sentence(
    error: OSError, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> socket.socket:
        raise error

    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    for scheme in ("tcp", "tcp+udp", "udp", "ws"):
        with pytest.raises(DeviceError, match=re.escape(f"Stream probe ({scheme}:arm.lab:7): {message}")):
            open_address(f"{scheme}:arm.lab:7", Quiet())


def test_what_is_no_websocket_is_told(rude_port: int) -> None:
    with pytest.raises(DeviceError, match=rf"127\.0\.0\.1 port {rude_port}"):
        open_address(f"ws:127.0.0.1:{rude_port}", Quiet())


def test_a_can_interface_that_is_missing_lists_those_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, kind in {"eth0": "1", "can1": "280"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
    monkeypatch.setattr(can, "INTERFACES", tmp_path)

    with pytest.raises(DeviceError, match=r"CAN interface can9; there is can1\."):
        open_address("can:socketcan:can9", Quiet())


def test_a_can_interface_that_does_not_open_tells_how_to_bring_it_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "can0").mkdir()
    (tmp_path / "can0" / "type").write_text("280\n")
    monkeypatch.setattr(can, "INTERFACES", tmp_path)

    def refuse(**_: object) -> None:
        raise OSError(errno.ENETDOWN, "Network is down")

    monkeypatch.setattr("can.Bus", refuse)
    with pytest.raises(DeviceError, match=r"Run `sudo ip link set can0 up type can bitrate 500000`\."):
        open_address("can:socketcan:can0@500000", Quiet())


def test_a_missing_adapter_of_slcan_is_told_as_any_serial_port() -> None:
    with pytest.raises(DeviceError, match="/dev/ttyNOWHERE"):
        open_address("can:slcan:/dev/ttyNOWHERE@1000000", Quiet())


@pytest.mark.parametrize("address", ["can:can0", "can:socketcan:", "can:slcan:/dev/ttyACM0@fast", "can:pcan:1"])
def test_a_can_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match=r"CAN.*can:KIND:CHANNEL"):
        open_address(address, Quiet())


def test_an_unknown_kind_of_address_lists_all() -> None:
    with pytest.raises(UsageError, match=r"'bluetooth:1'.*serial:/dev/ttyACM0"):
        parse("bluetooth:1")
