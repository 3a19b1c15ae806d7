"""Inside the virtual machine, make a HID device with the kernel's uhid and read it through `open_link`.

Prints one line, ``RESULT`` and JSON. Run as ``guest.py board`` it is the device: it reads commands as
`tests/links/hid_board.py` does. Run as ``guest.py camera`` it reads the kernel's ``vivid`` camera.
"""

import json
import os
import select
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.links.raw_hid import DESCRIPTOR, report  # noqa: E402

# Values of <linux/uhid.h>.
DESTROY, OUTPUT, CREATE, INPUT = 1, 6, 11, 12
CREATE_LAYOUT, INPUT_LAYOUT, EVENT = struct.Struct("<I128s64s64sHHIIII4096s"), struct.Struct("<IH4096s"), 4380
USB = 3  # BUS_USB of <linux/input.h>
COUNT, RATE_HZ, FLOOD = 3000, 1000, 200


def board() -> None:
    """Be the device until ``unplug``."""
    device = os.open("/dev/uhid", os.O_RDWR)
    name = b"Teensyduino RawHID"
    os.write(
        device,
        CREATE_LAYOUT.pack(CREATE, name, b"", b"12345", len(DESCRIPTOR), USB, 0x16C0, 0x0486, 0x0275, 0, DESCRIPTOR),
    )
    print("made", flush=True)
    for line in sys.stdin:
        words = line.split()
        if words[0] == "send":
            _send(device, int(words[1]), float(words[2]))
            print("sent", flush=True)
        elif words[0] == "heard":
            print(_heard(device).hex(), flush=True)
        else:
            break
    os.write(device, struct.pack("<I", DESTROY))
    os.close(device)


def _send(device: int, count: int, rate_hz: float) -> None:
    due = time.monotonic()
    for number in range(count):
        if rate_hz:
            time.sleep(max(0.0, due - time.monotonic()))
            due += 1 / rate_hz
        os.write(device, INPUT_LAYOUT.pack(INPUT, 64, report(number)))


def _heard(device: int) -> bytes:
    """Return the next report that was written to the device."""
    while select.select([device], [], [], 10)[0]:
        event = os.read(device, EVENT)
        if int.from_bytes(event[:4], "little") == OUTPUT:
            return event[4 : 4 + int.from_bytes(event[4100:4102], "little")]
    return b""


def reader() -> dict[str, Any]:
    """Return what a reader of the device sees."""
    from tacpipe.links import ports
    from tacpipe.links.link import LinkLostError, parse
    from tacpipe.links.opening import open_link
    from tacpipe.sensors.generic import RawHid

    with subprocess.Popen(
        [sys.executable, "-B", __file__, "board"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as device:
        assert device.stdin is not None and device.stdout is not None
        ask, answers = device.stdin, device.stdout

        def order(text: str) -> None:
            ask.write(f"{text}\n")
            ask.flush()

        assert answers.readline() == "made\n"
        _await_node()
        result: dict[str, Any] = {"kernel": os.uname().release, "ports": [str(port) for port in ports.hid_ports()]}
        link = open_link(parse("hid:16c0:0486"), RawHid(), "board")
        link.write(bytes(range(64)))
        order("heard")
        result["heard"] = answers.readline().strip()

        order(f"send {COUNT} {RATE_HZ}")
        received: list[tuple[int, bytes]] = []
        busy, start_s = time.process_time(), time.monotonic()
        while len(received) < COUNT and time.monotonic() - start_s < 60:
            received += link.read(0.5)
        result["busy_share"] = round((time.process_time() - busy) / (time.monotonic() - start_s), 3)
        result["rate_hz"] = round((len(received) - 1) * 1e9 / (received[-1][0] - received[0][0]), 1)
        result["seq"] = _counters(received)
        assert answers.readline() == "sent\n"

        order(f"send {FLOOD} 0")
        assert answers.readline() == "sent\n"
        result["flood"] = _counters([entry for _ in range(10) for entry in link.read(0.1)])

        order("unplug")
        try:
            for _ in range(100):
                link.read(0.1)
            result["lost"] = ""
        except LinkLostError as error:
            result["lost"] = str(error)
        link.close()
    return result


SIZE_PX, CAMERA_HZ, FRAMES, GAIN_VALUE = (320, 180), 10, 40, 77
DROPPED, DISCONNECT = 0xF0F000 + 64, 0xF0F000 + 65  # controls of vivid


def camera() -> dict[str, Any]:
    """Return what a recorder of vivid's camera sees."""
    from dataclasses import replace

    from tacpipe.errors import DeviceError
    from tacpipe.links import v4l2
    from tacpipe.links.link import LinkLostError, parse
    from tacpipe.links.opening import open_link
    from tacpipe.recording.reading import LinkReader
    from tacpipe.sensors import variants
    from tacpipe.sensors.camera import Camera, unpack_frame, unpack_settings
    from tacpipe.sensors.framing import Chunks
    from tacpipe.video.images import read_shape

    until = time.monotonic() + 30
    while not (ports := v4l2.cameras()) and time.monotonic() < until:
        time.sleep(0.1)
    address = parse(ports[0].address)
    result: dict[str, Any] = {"kernel": os.uname().release, "ports": [str(port) for port in ports]}
    width_px, height_px = SIZE_PX
    sensor = Camera(width_px=width_px, height_px=height_px, rate_hz=CAMERA_HZ, encoding="yuyv", gain=GAIN_VALUE)
    refused = {}
    for name, refused_sensor in (
        ("mjpeg", replace(sensor, encoding="mjpeg")),
        ("size", replace(sensor, width_px=333)),
        ("led", replace(sensor, led=3)),
    ):
        try:
            open_link(address, refused_sensor, "gel").close()
        except Exception as error:
            refused[name] = f"{type(error).__name__}: {error}"
    link = open_link(address, sensor, "gel")
    try:
        open_link(address, sensor, "other").close()
    except DeviceError as error:
        refused["busy"] = str(error)
    result["refused"] = refused

    def read(count: int) -> list[tuple[int, bytes]]:
        entries: list[tuple[int, bytes]] = []
        while len(entries) < count:
            entries += link.read(5.0)
        return entries

    busy, start_s = time.process_time(), time.monotonic()
    entries = read(FRAMES + 1)
    result["busy_share"] = round((time.process_time() - busy) / (time.monotonic() - start_s), 3)
    result["settings"] = unpack_settings(entries[0][1])
    result["options"] = variants.guess_options("camera", Chunks.from_pairs(entries))[0]
    frames = [frame for _, packet in entries if (frame := unpack_frame(packet)) is not None]
    result["numbers"] = [frame.number for frame in frames]
    result["stamps_ns"] = [t_ns for t_ns, _ in entries[1:]]
    result["now_ns"] = time.monotonic_ns()
    result["shapes"] = sorted({str(read_shape(frame.content)) for frame in frames})

    complete = Camera(**result["options"])
    reading = LinkReader(complete)
    batches = [reading.feed(Chunks.from_pairs(entries))]
    controls = v4l2.V4l2Device(address.target)
    controls.write_control(DROPPED, 50)
    batches.append(reading.feed(Chunks.from_pairs(read(FRAMES))))
    controls.write_control(DROPPED, 0)
    time.sleep(3.0)  # more frames come than the kernel has buffers for
    batches.append(reading.feed(Chunks.from_pairs(read(FRAMES))))
    batches.append(reading.finish())
    numbers = [int(number) for batch in batches if batch.seq is not None for number in batch.seq]
    result["skipped"] = numbers[-1] - numbers[0] + 1 - len(numbers)
    result["lost"] = reading.lost

    controls.write_control(DISCONNECT, 1)
    try:
        for _ in range(100):
            link.read(0.1)
        result["gone"] = ""
    except LinkLostError as error:
        result["gone"] = str(error)
    link.close()
    return result


def _await_node() -> None:
    until = time.monotonic() + 30
    while not list(Path("/dev").glob("hidraw*")) and time.monotonic() < until:
        time.sleep(0.1)


def _counters(received: list[tuple[int, bytes]]) -> list[int]:
    return [int.from_bytes(data[-2:], "big") for _, data in received]


if __name__ == "__main__":
    if sys.argv[1:] == ["board"]:
        board()
    elif sys.argv[1:] == ["camera"]:
        print("RESULT", json.dumps(camera()), flush=True)
    else:
        print("RESULT", json.dumps(reader()), flush=True)
