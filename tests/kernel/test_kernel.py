"""The real path of HID: Debian's kernel in a virtual machine, its uhid and hidraw, hidapi, and our link on top.

`make test-kernel` runs this; it takes about a minute and fetches the kernel once, so `make test` leaves it out.
"""

from __future__ import annotations

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


@pytest.fixture(scope="module")
def guest_result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Run the guest and return its result."""
    command = f"/usr/bin/env PYTHONPATH={HERE.parents[1]} HOME=/ {sys.executable} -B {HERE / 'guest.py'}"
    printed = machine.run(machine.kernel(CACHE), command, tmp_path_factory.mktemp("machine"))
    _, mark, result = printed.partition("RESULT ")  # The BIOS prints on the same line.
    assert mark, printed[-3000:]
    parsed: dict[str, Any] = json.loads(result.splitlines()[0])
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
