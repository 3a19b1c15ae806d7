"""Emulate a device that numbers what it sends, with the standard library only and nothing of tacpipe.

    python counted_device.py PORT

It sends a frame at a rate, over a pseudo-terminal and to a UDP port, and prints a line of JSON with the path of its
terminal. What it sends follows from the number alone, so a reader of a recording can compute it. Frames that the terminal
does not take yet wait in order and are never dropped. The file ``sent`` of its folder has the number of frames sent.
"""

import collections
import contextlib
import json
import os
import socket
import struct
import sys
import time
import tty

RATE_HZ = 200.0
MARK = b"\xa5\x5a"
WIRE = """
[[stream]]
name = "wire"
sensor = "generic"
transport = "serial:{terminal}"

[stream.options]
rate_hz = 200
marker = "A5 5A"
numbers = [{{ name = "n", type = "u32" }}, {{ name = "value", type = "u16" }}, {{ name = "check", type = "u8" }}]
sequence = {{ number = "n" }}
sum = {{ kind = "sum8", number = "check", begin = 2 }}
"""


def value(number: int) -> int:
    """Return the 16 bits that go with a number."""
    return (number * 40_503 + 7) % 65_536


def packet(number: int) -> bytes:
    """Return what is sent as a datagram: the number, and its value."""
    return struct.pack("<IH", number, value(number))


def frame(number: int) -> bytes:
    """Return what is sent over the terminal: a mark, the same, and the sum of all that lies between."""
    body = packet(number)
    return MARK + body + bytes([sum(body) % 256])


def main() -> None:
    """Send until somebody ends it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    print(json.dumps({"terminal": os.ttyname(slave)}), flush=True)
    target = ("127.0.0.1", int(sys.argv[1]))
    waiting: collections.deque[bytes] = collections.deque()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port, open("sent", "wb", buffering=0) as sent:
        began_s = time.monotonic()
        number = 0
        while True:
            while number <= (time.monotonic() - began_s) * RATE_HZ:
                waiting.append(frame(number))
                with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet
                    port.sendto(packet(number), target)
                number += 1
            with contextlib.suppress(BlockingIOError):
                while waiting:
                    unsent = waiting[0][os.write(master, waiting[0]) :]
                    waiting.popleft()
                    if unsent:
                        waiting.appendleft(unsent)
            os.pwrite(sent.fileno(), struct.pack("<Q", number), 0)
            time.sleep(0.5 / RATE_HZ)


if __name__ == "__main__":
    main()
