"""Measure the cost of sealing ten minutes of a 1 kHz arm: its spool turned into a durable recording.

    python benchmarks/sealing.py [--minutes 10]

The spool holds packets as the arm sends them, written by the sensor's own encoder in chunks as a recorder appends them.
`tacpipe acquire --recover` seals it in a process of its own, whose processor time and peak of resident memory are printed.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import timing

from tacpipe.datasets.manifest import find
from tacpipe.recording import rig as rig_of
from tacpipe.recording.spool import Spool
from tacpipe.recording.spool_folders import RecordingHeader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.store.store import Store

RIG = '[[stream]]\nname = "robot"\nsensor = "franka"\ntransport = "tcp+udp:172.16.0.2:1337"\n'
BLOCK = 1000  # packets that a recorder appends at a time
FLOATS = 41  # channels of floats that the arm gives


def write_spool(folder: Path, seconds: int) -> Path:
    """Write the spool of an arm that moves smoothly, as a killed recorder leaves it, and return its folder."""
    sensor = rig_of.parse(RIG).streams["robot"].sensor
    store = Store(folder / ".tacpipe")
    store.prepare()
    header: RecordingHeader = {"output": str(folder / "rec"), "recording": "long", "attributes": {}, "rig": RIG}
    spool = Spool(store.root, header, ["robot"])
    noise, total = np.random.default_rng(0), 0
    for second in range(seconds):
        count = np.arange(second * BLOCK, (second + 1) * BLOCK)
        angle = 0.3 * np.sin(count[:, None] / 1000 + np.arange(FLOATS))  # (sample, channel)
        floats = angle + noise.normal(scale=1e-3, size=angle.shape)
        floats[:, 3:7] = [0.0, 0.0, 0.0, 1.0]  # no turn of the end effector
        ones = np.ones((BLOCK, 1), dtype=np.float32)
        none = np.zeros((BLOCK, 3), dtype=np.uint8), np.zeros((BLOCK, 2), dtype=np.uint64)
        data = sensor.encode(Samples((floats, ones, *none), seq=count)).tobytes()
        total += len(data)
        spool.tally(0, len(count) * (second + 1), total, int(count[-1]) * 1_000_000)
        spool.append("robot", Chunks(count * 1_000_000, np.full(BLOCK, len(data) // BLOCK), data))
        spool.write()
    spool.close()
    return spool.folder


def main() -> None:
    """Write the spool, seal it and print what that took."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tacpipe-seal-") as name:
        folder = Path(name)
        spool_folder = write_spool(folder, round(60 * options.minutes))
        size = (spool_folder / "bytes").stat().st_size
        cost = timing.cost(["tacpipe", "acquire", "--recover"], folder)
        manifest = find(folder / "rec").manifest
        print(
            f"{options.minutes:g} min, {size / 1e6:,.0f} MB of spool: {cost.seconds:.1f} s, "
            f"{cost.cpu_s:.1f} s of processor time, {cost.memory_bytes / 1e6:,.0f} MB of memory at most"
        )
        for stream, shard in sorted(manifest.recordings["long"]["shards"].items()):
            print(f"{stream}: {shard['rows']:,} rows, {shard['bytes'] / 1e6:,.1f} MB, {shard['digest']}")


if __name__ == "__main__":
    main()
