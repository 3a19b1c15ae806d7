"""Serve emulated USB HID devices with umockdev. The program runs under the system's Python, for GObject introspection.

It imports nothing from tacpipe. Standard input has one command per line: ``add NUMBER VENDOR PRODUCT DESCRIPTOR NAME``
plugs a device in, ``send NUMBER REPORT`` sends a report; all numbers except NUMBER are hexadecimal. The first line of
standard output is the directory for UMOCKDEV_DIR. Each report of a host adds a line ``NUMBER REPORT``.
"""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from typing import Any

GET_SIZE, GET_DESCRIPTOR = 0x80044801, 0x90044802  # HIDIOCGRDESCSIZE and HIDIOCGRDESC of <linux/hidraw.h>
MAX_REPORT_BYTES = 4096  # bytes of a descriptor or a report
POLL_S = 0.02  # period of polling a device that no host has open


def describe_device(number: int, vendor: str, product: str, descriptor: str, name: str) -> str:
    """Return umockdev's description of a device: USB device, interface, HID device and hidraw node."""
    usb = f"/devices/pci0000:00/0000:00:14.0/usb1/1-{number + 1}"
    hid_name = f"0003:{vendor.upper()}:{product.upper()}.{number + 1:04d}"
    hid = f"{usb}/1-{number + 1}:1.0/{hid_name}"
    identity = f"0003:0000{vendor.upper()}:0000{product.upper()}"
    usb_lines = ["E: SUBSYSTEM=usb", "E: DEVTYPE=usb_device", rf"A: idVendor={vendor}\n", rf"A: idProduct={product}\n"]
    usb_lines += [r"A: manufacturer=tacpipe\n", rf"A: product={name}\n", rf"A: serial=emulated{number}\n"]
    hid_lines = ["E: SUBSYSTEM=hid", f"E: HID_ID={identity}", f"E: HID_NAME={name}", f"E: HID_UNIQ=emulated{number}"]
    hid_lines += [rf"A: uevent=HID_ID={identity}\nHID_NAME={name}\nHID_UNIQ=emulated{number}\n"]
    parts = [
        [f"P: {usb}", *usb_lines, r"A: bcdDevice=0100\n"],
        [f"P: {usb}/1-{number + 1}:1.0", "E: SUBSYSTEM=usb", "E: DEVTYPE=usb_interface", r"A: bInterfaceNumber=00\n"],
        [f"P: {hid}", *hid_lines, f"H: report_descriptor={descriptor}"],
        [f"P: {hid}/hidraw/hidraw{number}", f"N: hidraw{number}", "E: SUBSYSTEM=hidraw"],
    ]
    parts[3] += [f"E: DEVNAME=/dev/hidraw{number}", f"L: device=../../../{hid_name}"]
    return "".join("\n".join(part) + "\n\n" for part in parts)


def ioctl_handler(descriptor: bytes) -> Any:
    """Return a handler of the ioctl requests for a report descriptor."""

    def answer_request(_: Any, client: Any) -> bool:
        request = client.get_request()
        if request == GET_SIZE:
            client.get_arg().resolve(0, 4).update(0, len(descriptor).to_bytes(4, "little"))
        elif request == GET_DESCRIPTOR:
            client.get_arg().resolve(0, 4 + MAX_REPORT_BYTES).update(4, descriptor)
        else:
            return False
        client.complete(0, 0)
        return True

    return answer_request


def print_reports(number: int, board: int) -> None:
    """Print the reports that hosts write to a device."""
    while select.select([board], [], []):
        try:
            data = os.read(board, MAX_REPORT_BYTES)
        except OSError:  # another thread read it, or no host has the device open
            time.sleep(POLL_S)
            continue
        if data:
            print(number, data.hex(), flush=True)


def append_report(board: int, buffered: bytes, report: bytes) -> bytes:
    """Send a report after the remaining bytes of the previous one, and return the unsent bytes.

    If the previous one cannot be sent, the report is dropped, as in the kernel.
    """
    data = buffered or report
    try:
        data = data[os.write(board, data) :]
        if not data and buffered:
            data = report[os.write(board, report) :]
    except BlockingIOError:
        return buffered
    return data


def serve(mock: Any, testbed: Any, loop: Any) -> None:
    """Run the commands from standard input: add a device, or send a report of one."""
    boards: dict[str, int] = {}
    unsent: dict[str, bytes] = {}
    handlers = []
    for line in sys.stdin:
        command, number, *words = line.strip().split(maxsplit=5)
        if command == "add":
            testbed.add_from_string(describe_device(int(number), *words))
            handlers.append(mock.IoctlBase.new())
            handlers[-1].connect("handle-ioctl", ioctl_handler(bytes.fromhex(words[2])))
            testbed.attach_ioctl(f"/dev/hidraw{number}", handlers[-1])
            boards[number] = testbed.get_dev_fd(f"/dev/hidraw{number}")
            os.set_blocking(boards[number], False)
            threading.Thread(target=print_reports, args=(int(number), boards[number]), daemon=True).start()
            print(number, flush=True)
        elif number in boards:
            unsent[number] = append_report(boards[number], unsent.get(number, b""), bytes.fromhex(words[0]))
    loop.quit()


def main() -> None:
    """Serve devices until standard input ends."""
    import gi

    gi.require_version("UMockdev", "1.0")
    from gi.repository import GLib, UMockdev

    testbed, loop = UMockdev.Testbed.new(), GLib.MainLoop()
    print(testbed.get_root_dir(), flush=True)
    threading.Thread(target=serve, args=(UMockdev, testbed, loop), daemon=True).start()
    loop.run()


if __name__ == "__main__":
    main()
