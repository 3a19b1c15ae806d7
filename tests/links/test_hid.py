"""HID: the unmodified hidapi against a device that umockdev plays, and the choice among devices and interfaces."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import hid, ports
from tacpipe.links.ports import HidInterface
from tacpipe.sensors.generic import RawHid

HERE = Path(__file__).parent
SYSTEM_PYTHON = "/usr/bin/python3"


def why_not() -> str:
    """Return why umockdev cannot be used here, nothing where it can."""
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed"
    code = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    process = subprocess.run([SYSTEM_PYTHON, "-c", code], capture_output=True, check=False)
    return "" if process.returncode == 0 else "gir1.2-umockdev-1.0 or python3-gi is not installed"


AT_ONCE = 50  # reports: no more than the queue holds, however late they are fetched
RAW = RawHid()
LACKING = why_not()
mocked = pytest.mark.skipif(bool(LACKING), reason=LACKING)


def talk(count: int, rate_hz: int, *, unplug: bool = False) -> tuple[dict[str, Any], bytes]:
    """Have a board send so many reports; return what a client saw, and what the board heard."""
    with subprocess.Popen(
        ["umockdev-wrapper", SYSTEM_PYTHON, str(HERE / "hid_board.py")],
        env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as board:
        assert board.stdin is not None and board.stdout is not None
        root = board.stdout.readline().strip()

        def order(text: str) -> None:
            assert board.stdin is not None
            board.stdin.write(f"{text}\n")
            board.stdin.flush()

        with subprocess.Popen(
            [
                "umockdev-wrapper",
                sys.executable,
                str(HERE / "hid_client.py"),
                str(count),
                *(["lost"] if unplug else []),
            ],
            env={**os.environ, "UMOCKDEV_DIR": root},
            stdout=subprocess.PIPE,
            text=True,
        ) as client:
            assert client.stdout is not None
            assert client.stdout.readline() == "open\n"
            order("heard")
            heard = bytes.fromhex(board.stdout.readline())
            for start in range(0, count, AT_ONCE):
                batch_size = min(AT_ONCE, count - start)
                order(f"send {batch_size} {rate_hz}")
                while client.stdout.readline() != f"came {start + batch_size}\n":
                    assert client.poll() is None
            line = client.stdout.readline()
            order("unplug")
            if unplug:
                assert line == "waiting\n"
                board.wait()
                line = client.stdout.readlines()[-1]
        return json.loads(line), heard


@mocked
@pytest.mark.rig
def test_every_report_comes_and_what_is_written_arrives() -> None:
    summary, heard = talk(1500, 1000)

    assert summary["seq"] == list(range(1500))
    assert summary["first"] == [7 * number % 4096 for number in range(1500)]
    assert summary["monotone"] and summary["late"] == 0
    assert heard == b"\0" + bytes(range(64))  # the number of a report that has none leads
    assert summary["ports"] == ["hid:/dev/hidraw0 (16c0:0486, Teensyduino RawHID interface 0 usage page ffab)"]


@mocked
@pytest.mark.rig
def test_a_board_that_is_unplugged_is_lost() -> None:
    summary, _ = talk(20, 500, unplug=True)

    assert summary["seq"] == list(range(20))
    assert summary["lost"].startswith("Stream board (hid:16c0:0486) is lost: it was unplugged")


def interface(number: int, page: int, serial: str = "1", path: str = "") -> HidInterface:
    return {
        "path": (path or f"/dev/hidraw{number}").encode(),
        "vendor_id": 0x16C0,
        "product_id": 0x0486,
        "serial_number": serial,
        "usage_page": page,
        "interface_number": number,
        "product_string": "RawHID",
    }


TEENSY = [interface(1, 0xFFC9), interface(0, 0xFFAB)]


@pytest.mark.parametrize(
    ("place", "usage_page", "path"),
    [
        ("16c0:0486", 0xFFAB, b"/dev/hidraw0"),
        ("16C0:0486", None, b"/dev/hidraw0"),
        ("16c0:0486", 0xFFC9, b"/dev/hidraw1"),
        ("16c0:0486?interface=1", 0xFFAB, b"/dev/hidraw1"),
        ("16c0:0486?usage_page=FFC9", None, b"/dev/hidraw1"),
        ("/dev/hidraw1", None, b"/dev/hidraw1"),
    ],
)
def test_of_the_interfaces_of_one_device_the_right_one_is_taken(
    place: str, usage_page: int | None, path: bytes
) -> None:
    assert hid.choose_interface(place, TEENSY, usage_page, "probe")["path"] == path


def test_of_a_teensy_s_interfaces_raw_hid_takes_the_one_of_its_usage_page() -> None:
    keyboard_first = [interface(0, 0x0001), interface(1, 0xFFAB)]

    assert hid.choose_interface("16c0:0486", keyboard_first, RAW.usage_page, "probe")["path"] == b"/dev/hidraw1"


def test_two_devices_of_one_kind_must_be_told_apart() -> None:
    two = [*TEENSY, interface(0, 0xFFAB, "2", "/dev/hidraw4")]

    with pytest.raises(DeviceError, match=r"2 devices.*16c0:0486.*hid:16c0:0486\?serial=1"):
        hid.choose_interface("16c0:0486", two, 0xFFAB, "probe")
    assert hid.choose_interface("16c0:0486?serial=2", two, 0xFFAB, "probe")["path"] == b"/dev/hidraw4"
    with pytest.raises(UsageError, match="usage_page"):
        hid.choose_interface("16c0:0486?number=2", two, 0xFFAB, "probe")


def test_a_missing_device_lists_those_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    port = ports.Port("hid:/dev/hidraw3", "256f:c635", "SpaceMouse interface 0 usage page 0001")
    monkeypatch.setattr(ports, "hid_ports", lambda: [port])

    with pytest.raises(DeviceError, match=r"HID.*16c0:0486; there is hid:/dev/hidraw3 \(256f:c635"):
        hid.choose_interface("16c0:0486", [], None, "probe")


def test_a_device_without_the_right_to_it_tells_the_rule_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refusing:
        def open_path(self, path: bytes) -> None:
            raise OSError("open failed")

    module = type("Hidapi", (), {"device": Refusing, "enumerate": staticmethod(lambda: [interface(0, 0xFFAB)])})
    monkeypatch.setattr(ports, "hid_module", lambda: module)
    monkeypatch.setattr(os, "access", lambda *_: False)

    with pytest.raises(DeviceError) as refused:
        hid.open_hid("16c0:0486", RAW, "Stream probe")
    assert 'KERNEL=="hidraw*", ATTRS{idVendor}=="16c0", ATTRS{idProduct}=="0486", MODE="0660", TAG+="uaccess"' in str(
        refused.value
    )


def test_another_package_in_the_place_of_hidapi_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    module = type(sys)("hidraw")
    module.Device = object  # type: ignore[attr-defined]  # The package hid has this class
    monkeypatch.setitem(sys.modules, "hidraw", module)
    monkeypatch.setitem(sys.modules, "hid", module)

    with pytest.raises(DeviceError, match="`pip uninstall hid`, then `pip install --force-reinstall hidapi`"):
        ports.hid_module()
    assert ports.hid_ports() == []


def test_numbered_reports_are_told_from_others_by_the_descriptor() -> None:
    # a mouse of three axes as report 1 (6 bytes) and buttons as report 3 (32 bits), after HID 1.11, appendix E
    spoken = "0501 0908 a101 8501 1600fe 26ff01 7510 9503 8102 8503 7501 9520 8102 c0"
    reports = hid.parse_report_descriptor(bytes.fromhex(spoken))

    assert reports == hid.Reports(1, {1: 48, 3: 32})
    assert (reports.has_numbers, reports.max_size) == (True, 7)
    assert hid.parse_report_descriptor(b"").max_size == 64
