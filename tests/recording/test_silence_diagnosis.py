"""Test the sentence about a device that is missing, held, forbidden, silent, set otherwise or another one."""

import errno
import os
import re
import socket
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Lab, without_created_store
from tests.emulation.emulator import Emulator
from tests.recording import live

pytestmark = pytest.mark.rig
SLOW = live.stream("slow", "optoforce", "serial:/dev/ttyACM1", "{ axes = 3, rate_hz = 100, baud = 115200 }")
ORIGINAL = live.stream("plain", "tfmini", "serial:/dev/ttyUSB1", '{ model = "original" }')


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    folder = tmp_path_factory.mktemp("served")
    with live.served(folder, SLOW, ORIGINAL, live.RANGE, live.SKIN) as emulator:
        yield emulator


@pytest.fixture(autouse=True)
def patience(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for a first frame as long as a test can bear where none comes, and as usual where a device sends others."""
    if "served" not in request.fixturenames:
        monkeypatch.setattr("tacpipe.recording.recorder.FIRST_S", 1.0)


@pytest.fixture
def silent() -> Iterator[str]:
    """A port behind which nothing speaks."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def refuse(lab: Lab, *streams: str) -> list[str]:
    """Return the sentences of a recording that does not begin, one a stream; fails if anything was written."""
    (lab.folder / "rig.toml").write_text("".join(streams))
    ran = lab.call("acquire rig.toml -o rec --duration-s 1")
    assert ran.code == 5, ran.err
    assert not ran.out and not (lab.folder / "rec").exists()
    assert not list((lab.folder / ".tacpipe/spool").glob("*"))
    err = without_created_store(ran.err)
    assert err.startswith("tacpipe: ") and "Traceback" not in err
    return err.removeprefix("tacpipe: ").splitlines()


def place(served: Emulator, name: str) -> str:
    return str(served.rig.streams[name].address)


def test_a_port_that_is_not_there_is_named_with_those_that_are(lab: Lab) -> None:
    (message,) = refuse(lab, live.stream("force", "optoforce", "serial:/dev/gone"))

    assert re.fullmatch(
        r"Stream force \(serial:/dev/gone\): there is no port /dev/gone; there (is|are) .+\. "
        r"Plug the device in, or correct the transport\.",
        message,
    )


def test_a_port_that_another_program_holds_is_told_with_that_program(lab: Lab, silent: str) -> None:
    program = (
        "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=True); print(flush=True); sys.stdin.read()"
    )
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", program, silent], **pipes) as holder:
        assert holder.stdout is not None and holder.stdin is not None
        holder.stdout.readline()
        (message,) = refuse(lab, live.stream("force", "optoforce", f"serial:{silent}"))
        holder.stdin.close()

    about = re.escape(f"Stream force (serial:{silent}): {silent} is used by ")
    assert re.fullmatch(
        rf"{about}.+ \(process {holder.pid}\).*; stop it, because two programs cannot read the same port\.", message
    )


def test_a_port_that_is_forbidden_is_told_with_the_group_that_may(
    lab: Lab, silent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def forbidden(path: Any, *args: Any, **kwargs: Any) -> int:
        if path == silent:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        return real(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", forbidden)
    (message,) = refuse(lab, live.stream("force", "optoforce", f"serial:{silent}"))

    group = r"it belongs to the group \w+: run `sudo usermod -aG \w+ \$USER`, then log in again\."
    about = re.escape(f"Stream force (serial:{silent}): you may not open {silent}; ")
    assert re.fullmatch(about + group, message)


def test_a_silent_port_is_told_with_its_rate(lab: Lab, silent: str) -> None:
    (message,) = refuse(lab, live.stream("force", "optoforce", f"serial:{silent}"))

    assert message == (
        f"Stream force (serial:{silent}): a frame of optoforce was awaited for 1 s, but nothing was received. Check power "
        f"and cable, and that it is optoforce, set to 1000000 baud; `tacpipe sensors probe serial:{silent}` tries all "
        "rates."
    )


def test_a_device_that_does_not_answer_at_all_is_told_with_what_was_awaited(lab: Lab, silent: str) -> None:
    (message,) = refuse(lab, live.stream("range", "tfmini", f"serial:{silent}"))

    assert message.startswith(
        f"Stream range (serial:{silent}): the reply to command 0x05 was awaited for 2 s, but nothing was received."
    )


@pytest.mark.parametrize("baud", [9600, 57600, 460800])
def test_a_port_at_another_rate_is_told_as_a_possibility(lab: Lab, served: Emulator, baud: int) -> None:
    at = place(served, "range")
    (message,) = refuse(lab, live.stream("range", "tfmini", at, f"{{ baud = {baud} }}"))

    assert re.fullmatch(
        re.escape(f"Stream range ({at}): the reply to command 0x05 was awaited for 2 s, but ")
        + r"the [\d,]+ bytes received contain none\. "
        + re.escape(f"The device is set to another rate than {baud} baud, or uses another protocol; ")
        + re.escape(f"`tacpipe sensors probe {at}` tries all supported sensors."),
        message,
    )


def test_another_sensor_is_named(lab: Lab, served: Emulator) -> None:
    at = place(served, "range")
    (message,) = refuse(lab, live.stream("force", "optoforce", at, "{ baud = 115200 }"))

    assert re.fullmatch(
        re.escape(f"Stream force ({at}): a frame of optoforce was awaited for 3 s, but ")
        + r"the [\d,]+ bytes received contain none\. They are frames of tfmini: set that sensor in the rig file, or plug "
        r"in the other device\.",
        message,
    )


def test_another_sensor_than_the_one_that_should_answer_is_named(lab: Lab, served: Emulator) -> None:
    (message,) = refuse(lab, live.stream("pad", "paxini", place(served, "range"), "{ baud = 115200 }"))

    assert "They are frames of tfmini: set that sensor in the rig file" in message


def test_a_sensor_that_sends_and_does_not_answer_is_told_from_another_one(lab: Lab, served: Emulator) -> None:
    (message,) = refuse(lab, live.stream("range", "tfmini", place(served, "plain")))

    assert message.endswith(
        "bytes received contain none. They are frames of tfmini, so the device does not receive our requests or is another "
        "model: check the transmit wire, and the model in the rig file."
    )


@pytest.mark.parametrize(
    ("stream", "sensor", "options", "expected_options"),
    [
        ("slow", "optoforce", "{ axes = 6, rate_hz = 100, filter_hz = 5.0, baud = 115200 }", "optoforce (axes = 3)"),
        ("skin", "xela", "{ sensor = 3 }", "xela (sensor = 1)"),
    ],
)
def test_the_option_that_is_wrong_is_named(
    lab: Lab, served: Emulator, stream: str, sensor: str, options: str, expected_options: str
) -> None:
    (message,) = refuse(lab, live.stream("load", sensor, place(served, stream), options))

    assert message.endswith(f"They are frames of {expected_options}: set these options in the rig file.")


def test_a_port_that_nobody_serves_is_told(lab: Lab) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    (skin, robot) = refuse(
        lab,
        live.stream("skin", "xela", f"ws:127.0.0.1:{port}"),
        live.stream("robot", "ur-rtde", f"tcp:127.0.0.1:{port}"),
    )

    end = f"127.0.0.1 is reachable, but refuses port {port}; start the program or device mode that serves it, "
    assert skin == f"Stream skin (ws:127.0.0.1:{port}): {end}and disconnect other clients."
    assert robot == f"Stream robot (tcp:127.0.0.1:{port}): {end}and disconnect other clients."


def test_a_box_that_refuses_datagrams_is_told(lab: Lab) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (message,) = refuse(lab, live.stream("wrench", "ati-netft", f"udp:127.0.0.1:{port}"))

    assert message == (
        f"Stream wrench (udp:127.0.0.1:{port}) is lost: the host refuses the port. Check the port, and that the "
        f"device streams."
    )


def test_a_box_that_sends_no_datagram_is_told(lab: Lab) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(("127.0.0.1", 0))
        at = f"udp:127.0.0.1:{box.getsockname()[1]}"
        (message,) = refuse(lab, live.stream("wrench", "ati-netft", at))

    assert message == (
        f"Stream wrench ({at}): a frame of ati-netft was awaited for 1 s, but nothing was received. Check power and "
        f"cable, and that it is ati-netft. The box sends to one program: if another requests records, they stop here."
    )


def test_every_stream_that_is_wrong_has_a_sentence(lab: Lab, served: Emulator, tmp_path: Path) -> None:
    messages = refuse(
        lab,
        live.stream("one", "optoforce", "serial:/dev/gone"),
        live.stream("good", "tfmini", place(served, "range")),
        live.stream("two", "xela", "ws:127.0.0.1:1"),
        live.stream("three", "optoforce", f"serial:{tmp_path}"),
    )

    assert [line.split()[1] for line in messages] == ["one", "two", "three"]
    assert f"{tmp_path} is not a serial port" in messages[2]
