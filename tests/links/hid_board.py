"""A RawHID board as umockdev plays it, run by the system's Python, which has GObject introspection. No test by itself.

Needs the project's root in PYTHONPATH. Prints the folder to run clients with. Reads commands from standard input, a line
each: ``send COUNT RATE_HZ`` sends so many more reference reports, ``heard`` prints what clients wrote, ``unplug`` ends it.
"""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from typing import Any

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

from tests.links.raw_hid import DESCRIPTOR, report  # noqa: E402

NODE = "/dev/hidraw0"
GET_SIZE, GET_DESCRIPTOR = 0x80044801, 0x90044802  # HIDIOCGRDESCSIZE and HIDIOCGRDESC of <linux/hidraw.h>
USB = "/devices/pci0000:00/0000:00:14.0/usb1/1-1"
HID = f"{USB}/1-1:1.0/0003:16C0:0486.0001"
DEVICES = f"""P: {USB}
E: SUBSYSTEM=usb
E: DEVTYPE=usb_device
E: ID_VENDOR=Teensyduino
A: idVendor=16c0\\n
A: idProduct=0486\\n
A: manufacturer=Teensyduino\\n
A: product=Teensyduino RawHID\\n
A: serial=12345\\n
A: bcdDevice=0275\\n

P: {USB}/1-1:1.0
E: SUBSYSTEM=usb
E: DEVTYPE=usb_interface
A: bInterfaceNumber=00\\n

P: {HID}
E: SUBSYSTEM=hid
E: HID_ID=0003:000016C0:00000486
E: HID_NAME=Teensyduino Teensyduino RawHID
E: HID_UNIQ=12345
A: uevent=HID_ID=0003:000016C0:00000486\\nHID_NAME=Teensyduino Teensyduino RawHID\\nHID_UNIQ=12345\\n
H: report_descriptor={DESCRIPTOR.hex()}

P: {HID}/hidraw/hidraw0
N: hidraw0
E: SUBSYSTEM=hidraw
E: DEVNAME={NODE}
L: device=../../../0003:16C0:0486.0001

"""


def answer(_: Any, client: Any) -> bool:
    """Answer the questions for the report descriptor."""
    request = client.get_request()
    if request == GET_SIZE:
        client.get_arg().resolve(0, 4).update(0, len(DESCRIPTOR).to_bytes(4, "little"))
    elif request == GET_DESCRIPTOR:
        argument = client.get_arg().resolve(0, 4 + 4096)
        argument.update(4, DESCRIPTOR)
    else:
        return False
    client.complete(0, 0)
    return True


def obey(board: int, loop: Any) -> None:
    """Carry out the commands of standard input."""
    heard, sent = b"", 0
    for line in sys.stdin:
        words = line.split()
        if words[0] == "send":
            due = time.monotonic()
            for number in range(sent, sent + int(words[1])):
                time.sleep(max(0.0, due - time.monotonic()))
                os.write(board, report(number))
                due += 1 / float(words[2])
            sent += int(words[1])
        elif words[0] == "heard":
            while len(heard) < 65 and select.select([board], [], [], 5)[0]:
                heard += os.read(board, 65 - len(heard))
            print(heard.hex(), flush=True)
        else:
            break
    loop.quit()


def main() -> None:
    """Play the board until it is unplugged."""
    testbed = UMockdev.Testbed.new()
    testbed.add_from_string(DEVICES)
    handler = UMockdev.IoctlBase.new()
    handler.connect("handle-ioctl", answer)
    testbed.attach_ioctl(NODE, handler)
    loop = GLib.MainLoop()
    board = testbed.get_dev_fd(NODE)
    print(testbed.get_root_dir(), flush=True)
    threading.Thread(target=obey, args=(board, loop), daemon=True).start()
    loop.run()


if __name__ == "__main__":
    main()
