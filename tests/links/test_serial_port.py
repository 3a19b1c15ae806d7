"""Test that serial ports are opened exclusively, with the sensor's settings, and that errors explain failures."""

import errno
import os
import pty
import stat
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.errors import DeviceError
from tacpipe.links import ports
from tacpipe.sensors.sensor import Sensor, SerialLine
from tests.links.peers import Quiet, open_address

HOLDER = """
import serial, sys
port = serial.Serial(sys.argv[1], exclusive=True)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The master of a pseudo-terminal, and the path of its slave."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("baud", [115_200, 123_456, 2_000_000, 4_000_000])
def test_any_rate_of_baud_can_be_set(baud: int, terminal: tuple[int, str]) -> None:
    master, path = terminal
    sensor = Quiet()
    sensor.baud = baud

    link = open_address(f"serial:{path}", sensor)
    os.write(master, b"abc")

    assert link.read(5)[0][1] == b"abc"
    standard = termios.__dict__.get(f"B{baud}")
    if standard is not None:
        assert termios.tcgetattr(master)[4] == standard
    link.close()


def test_control_lines_that_a_terminal_does_not_have_do_no_harm(terminal: tuple[int, str]) -> None:
    class Wired(Quiet):
        line = SerialLine(dtr=True, rts=False)

    link = open_address(f"serial:{terminal[1]}", Wired())
    link.write(b"ok")
    assert os.read(terminal[0], 2) == b"ok"
    link.close()


def test_what_comes_while_a_device_boots_is_thrown_away(
    terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Booting(Quiet):
        line = SerialLine(settle_s=1.5)

    slept = []

    def boot(seconds: float) -> None:
        slept.append(seconds)
        os.write(terminal[0], b"Hello from the bootloader\r\n")

    monkeypatch.setattr(time, "sleep", boot)
    link = open_address(f"serial:{terminal[1]}", Booting())
    os.write(terminal[0], b"frame")

    assert slept == [1.5]
    assert b"".join(data for _, data in link.read(1)) == b"frame"
    link.close()


def test_a_port_that_another_program_holds_is_busy_and_the_program_is_named(terminal: tuple[int, str]) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, terminal[1]], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None and holder.stdin is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(DeviceError, match=rf"\b{holder.pid}\b") as refused:
            open_address(f"serial:{terminal[1]}", Quiet())
        holder.stdin.close()

    assert refused.value.exit_code == 5
    open_address(f"serial:{terminal[1]}", Quiet()).close()  # The port is free again


def test_a_port_that_another_program_reads_without_locking_it_is_busy_too(
    terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "PSEUDO", "/nowhere")  # The port counts as a real cable
    with subprocess.Popen([sys.executable, "-c", HOLDER.replace("exclusive=True", ""), terminal[1]],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:  # fmt: skip
        assert holder.stdout is not None and holder.stdin is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(DeviceError, match=rf"\b{holder.pid}\b"):
            open_address(f"serial:{terminal[1]}", Quiet())
        holder.stdin.close()


def test_a_missing_port_lists_those_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    port_info = ListPortInfo("/dev/ttyACM7")
    port_info.vid, port_info.pid, port_info.product = 0x16D0, 0x14CC, "TSF-85"
    monkeypatch.setattr(list_ports, "comports", lambda: [port_info])

    with pytest.raises(DeviceError) as missing:
        open_address("serial:/dev/ttyACM0", Quiet())

    assert str(missing.value) == (
        "Stream probe (serial:/dev/ttyACM0): there is no port /dev/ttyACM0; there is serial:/dev/ttyACM7 (16d0:14cc, "
        "TSF-85). Plug the device in, or correct the transport."
    )


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.EACCES, r"you may not open .+; it belongs to the group \w+: run `sudo usermod -aG \w+ \$USER`"),
        (errno.EBUSY, r"is used by a process of another user; stop it"),
        (errno.EIO, r"cannot be opened: Input/output error\. Unplug it and plug it in again"),
    ],
)
def test_what_the_system_answers_becomes_a_sentence(
    number: int, message: str, terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(ports, "holders_of_file", lambda _: [])
    monkeypatch.setattr("serial.serialposix.os.open", refuse)

    with pytest.raises(DeviceError, match=message):
        open_address(f"serial:{terminal[1]}", Quiet())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_without_the_right_to_it_says_how_to_get_it(terminal: tuple[int, str]) -> None:
    Path(terminal[1]).chmod(0)
    with pytest.raises(DeviceError, match="usermod -aG"):
        open_address(f"serial:{terminal[1]}", Quiet())
    Path(terminal[1]).chmod(stat.S_IRUSR | stat.S_IWUSR)


def test_a_file_is_no_serial_port(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none")
    with pytest.raises(DeviceError, match=r"notes\.txt"):
        open_address(f"serial:{tmp_path / 'notes.txt'}", Quiet())


def test_a_device_that_takes_no_byte_is_lost_after_a_while(
    terminal: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.links.link.WRITE_S", 0.2)
    sensor: Sensor = Quiet()
    link = open_address(f"serial:{terminal[1]}", sensor)
    with pytest.raises(DeviceError, match=r"0\.2 s"):
        link.write(bytes(1 << 20))
    link.close()
