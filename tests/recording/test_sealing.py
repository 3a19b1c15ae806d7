"""A long recording is sealed without being in memory twice, and its bytes are those of its table."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np

from tacpipe.io import parquet
from tacpipe.io.hashing import bytes_digest
from tacpipe.recording import appending, sealing
from tacpipe.recording import rig as rig_of
from tacpipe.recording.spool import Spool
from tacpipe.recording.spooled import Spooled
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.store.store import Store

RIG = '[[stream]]\nname = "robot"\nsensor = "franka"\ntransport = "tcp+udp:172.16.0.2:1337"\n'
BLOCK = 1000


def recorded(store: Store, seconds: int) -> Spooled:
    """Return the spool of an arm that sent a state every millisecond."""
    sensor = rig_of.parse(RIG).streams["robot"].sensor
    spool = Spool(store.root, {"output": "rec", "recording": "r", "attributes": {}, "rig": RIG}, ["robot"])
    for second in range(seconds):
        count = np.arange(second * BLOCK, (second + 1) * BLOCK)
        floats = np.sin(count[:, None] + np.arange(41.0))  # (sample, channel)
        floats[:, 3:7] = [0.0, 0.0, 0.0, 1.0]
        one = np.ones((BLOCK, 1), dtype=np.float32)
        none = np.zeros((BLOCK, 3), dtype=np.uint8), np.zeros((BLOCK, 2), dtype=np.uint64)
        data = sensor.encode(Samples((floats, one, *none), seq=count)).tobytes()
        spool.append("robot", Chunks(count * 1_000_000, np.full(BLOCK, len(data) // BLOCK), data))
        spool.write()
    spool.close()
    return Spooled(spool.folder)


def test_what_is_decoded_of_a_long_stream_is_in_memory_once(tmp_path: Path) -> None:
    store = Store(tmp_path / ".tacpipe")
    store.prepare()
    read, rig = recorded(store, 100), rig_of.parse(RIG)
    sealing.seal(recorded(store, 2), rig)  # what is loaded for it does not count
    tracemalloc.start()
    try:
        table = sealing.seal(read, rig)["robot"].table
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert table.num_rows == 100 * BLOCK
    blocks = 12 << 20  # bytes, being decoded
    assert most < 1.4 * table.nbytes + blocks


def test_a_sealed_stream_has_the_bytes_of_its_table(tmp_path: Path) -> None:
    store = Store(tmp_path / ".tacpipe")
    store.prepare()
    read, rig = recorded(store, 3), rig_of.parse(RIG)
    sealed = sealing.seal(read, rig)
    with store.at_work():
        appending.append(store, tmp_path / "rec", read, rig, sealed)

    (stored,) = (tmp_path / "rec" / "r").glob("robot.parquet")
    assert stored.read_bytes() == parquet.to_parquet(sealed["robot"].table)
    assert bytes_digest(stored.read_bytes()) in {path.name for path in (tmp_path / ".tacpipe/objects").rglob("*")}
