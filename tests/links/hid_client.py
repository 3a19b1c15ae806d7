"""Reads a HID device through `open_link` and prints what came as JSON, for a test that prepares the surroundings.

Arguments: how many reports to wait for, and then whether to wait for the device to go away. No test by itself.
"""

import json
import sys
import time

from tacpipe.links import ports
from tacpipe.links.link import LinkLostError, parse
from tacpipe.links.opening import open_link
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.generic import RawHid


def main(count: int, *, until_lost: bool) -> None:
    """Print ``open`` once the device is open, the number of reports after each read, and a summary at the end."""
    port_names = [str(port) for port in ports.hid_ports()]
    sensor = RawHid()
    link = open_link(parse("hid:16c0:0486"), sensor, "board")
    link.write(bytes(range(64)))
    print("open", flush=True)
    reports: list[tuple[int, bytes]] = []
    lost = ""
    start_s, busy = time.monotonic(), time.process_time()
    while len(reports) < count and time.monotonic() - start_s < 600:
        reports += link.read(0.5)
        print(f"came {len(reports)}", flush=True)
    busy = time.process_time() - busy
    waited = link.read(0.05)
    try:
        while until_lost and time.monotonic() - start_s < 60:
            print("waiting", flush=True)
            link.read(2)
    except LinkLostError as error:
        lost = str(error)
    link.close()
    link.close()
    samples = [sensor.decode(run.frames) for run in sensor.framer().feed(Chunks.from_pairs(reports))[0]]
    seq = [int(value) for sample in samples for value in (sample.seq if sample.seq is not None else [])]
    first = [int(value) for sample in samples for value in sample.values[0][:, 0]]
    stamps = [t_ns for t_ns, _ in reports]
    span_s = (stamps[-1] - stamps[0]) / 1e9 if stamps else 0.0
    summary = {
        "ports": port_names,
        "seq": seq,
        "first": first,
        "late": len(waited),
        "lost": lost,
        "monotone": stamps == sorted(stamps),
        "busy_share": busy / max(1e-9, span_s),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main(int(sys.argv[1]), until_lost="lost" in sys.argv[2:])
