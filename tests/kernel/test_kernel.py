"""Real paths of HID and V4L2: Debian's kernel in a virtual machine, its uhid, hidraw and vivid, and our links on top.

`make test-kernel` runs this; it takes about three minutes and fetches the kernel once, so `make test` leaves it out.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.kernel import guest, machine

HERE = Path(__file__).parent
CACHE = HERE.parents[1] / ".cache" / "kernel"
QUEUED = 63  # reports that hidraw keeps: HIDRAW_BUFFER_SIZE of the kernel's <linux/hidraw.h>, less one

pytestmark = [
    pytest.mark.skipif("TACPIPE_TEST_KERNEL" not in os.environ, reason="`make test-kernel` runs it"),
    pytest.mark.skipif(bool(machine.lacking()), reason=f"{machine.lacking()} is not installed"),
]


def run_guest(scratch: Path, part: str = "") -> dict[str, Any]:
    """Run a part of the guest in the machine and return its result."""
    command = f"/usr/bin/env PYTHONPATH={HERE.parents[1]} HOME=/ {sys.executable} -B {HERE / 'guest.py'} {part}"
    printed = machine.run(machine.kernel(CACHE), command, scratch)
    _, mark, result = printed.partition("RESULT ")  # The BIOS prints on the same line.
    assert mark, printed[-3000:]
    parsed: dict[str, Any] = json.loads(result.splitlines()[0])
    return parsed


@pytest.fixture(scope="module")
def camera_result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Read the kernel's vivid camera and return the result."""
    pytest.importorskip("av", reason="PyAV is not installed")
    parsed = run_guest(tmp_path_factory.mktemp("machine"), "camera")
    print(f"\n{parsed['kernel']}, {parsed['busy_share']} of a core, {parsed['skipped']} frames dropped on purpose")
    return parsed


@pytest.fixture(scope="module")
def guest_result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Run the guest and return its result."""
    parsed = run_guest(tmp_path_factory.mktemp("machine"))
    figures = {key: parsed[key] for key in ("kernel", "rate_hz", "busy_share")}
    print(
        f"\n{figures}, {len(parsed['seq'])} of {guest.COUNT} reports, {len(parsed['flood'])} of a flood of {guest.FLOOD}"
    )
    return parsed


def test_the_device_is_found_by_its_usage_page(guest_result: dict[str, Any]) -> None:
    assert len(guest_result["ports"]) == 1
    assert guest_result["ports"][0].startswith("hid:/dev/hidraw0 (16c0:0486")
    assert guest_result["ports"][0].endswith("usage page ffab)")


def test_every_report_comes_at_a_thousand_a_second(guest_result: dict[str, Any]) -> None:
    assert guest_result["seq"] == list(range(guest.COUNT))


def test_a_report_that_is_written_arrives(guest_result: dict[str, Any]) -> None:
    assert bytes.fromhex(guest_result["heard"]) == b"\0" + bytes(range(64))


def test_of_a_flood_the_kernel_keeps_the_oldest_reports(guest_result: dict[str, Any]) -> None:
    assert guest_result["flood"] == list(range(QUEUED))


def test_a_device_that_goes_away_is_lost(guest_result: dict[str, Any]) -> None:
    assert guest_result["lost"].startswith("Stream board (hid:16c0:0486) is lost: it was unplugged")


def test_a_camera_is_found_by_its_name(camera_result: dict[str, Any]) -> None:
    assert [port.partition(" ")[0] for port in camera_result["ports"]] == ["v4l2:/dev/video0"]
    assert "vivid" in camera_result["ports"][0]


def test_frames_have_the_numbers_and_stamps_of_the_kernel(camera_result: dict[str, Any]) -> None:
    numbers, stamps_ns = camera_result["numbers"], camera_result["stamps_ns"]
    assert len(numbers) >= guest.FRAMES
    assert numbers == sorted(set(numbers))
    assert stamps_ns == sorted(set(stamps_ns))
    assert stamps_ns[-1] < camera_result["now_ns"]


def test_frames_of_yuyv_are_images_of_the_requested_size_and_the_loss_is_stated(camera_result: dict[str, Any]) -> None:
    width_px, height_px = guest.SIZE_PX
    assert camera_result["shapes"] == [
        f"ImageShape(width_px={width_px}, height_px={height_px}, pixel_format='yuvj422p')"
    ]
    assert "which loses some detail" in camera_result["options"]["read_back"]


def test_controls_are_set_and_read_back(camera_result: dict[str, Any]) -> None:
    assert f"Gain={guest.GAIN_VALUE}," in camera_result["settings"]["read_back"]
    assert "Gain, Automatic=0," in camera_result["settings"]["read_back"]
    assert camera_result["options"]["rate_hz"] == guest.CAMERA_HZ


def test_every_dropped_frame_is_counted(camera_result: dict[str, Any]) -> None:
    assert camera_result["skipped"] > 20
    assert camera_result["lost"] == camera_result["skipped"]


def test_what_a_camera_does_not_send_is_refused(camera_result: dict[str, Any]) -> None:
    refused = camera_result["refused"]
    assert "the camera does not send mjpeg; it sends " in refused["mjpeg"] and "YUYV" in refused["mjpeg"]
    assert "pixels instead of 333 x 180" in refused["size"]
    assert "led cannot be set to 3" in refused["led"]
    assert "/dev/video0 is in use by" in refused["busy"]


def test_a_camera_that_goes_away_is_lost(camera_result: dict[str, Any]) -> None:
    assert "is lost: it was unplugged" in camera_result["gone"]
