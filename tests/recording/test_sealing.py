"""Test that a long recording is sealed without being in memory, and its bytes are those of its table."""

from pathlib import Path

import numpy as np
import pytest

from tacpipe.io import parquet
from tacpipe.io.hashing import bytes_digest
from tacpipe.recording import appending, sealing
from tacpipe.recording import rig as rig_of
from tacpipe.recording.spool import Spool, Spooled
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.store.store import Store
from tests import peaks
from tests.conftest import Lab

RIG = '[[stream]]\nname = "robot"\nsensor = "franka"\ntransport = "tcp+udp:172.16.0.2:1337"\n'
BLOCK = 1000


def record(store: Store, seconds: int, output: str = "rec", repeated: int = 0) -> Spooled:
    """Return the spool of an arm that sent a state every millisecond, and the last of each second ``repeated`` times."""
    sensor = rig_of.parse(RIG).streams["robot"].sensor
    spool = Spool(store.root, {"output": output, "recording": "r", "attributes": {}, "rig": RIG}, ["robot"])
    for second in range(seconds):
        count = np.arange(second * BLOCK, (second + 1) * BLOCK)
        floats = np.sin(count[:, None] + np.arange(41.0))  # (sample, channel)
        floats[:, 3:7] = [0.0, 0.0, 0.0, 1.0]
        unit_floats = np.ones((BLOCK, 1), dtype=np.float32)
        zeros = np.zeros((BLOCK, 3), dtype=np.uint8), np.zeros((BLOCK, 2), dtype=np.uint64)
        data = sensor.encode(Samples((floats, unit_floats, *zeros), seq=count)).tobytes()
        size = len(data) // BLOCK
        spool.append("robot", Chunks(count * 1_000_000, np.full(BLOCK, size), data))
        for _ in range(repeated):
            spool.append("robot", Chunks(count[-1:] * 1_000_000, np.full(1, size), data[-size:]))
        spool.write()
    spool.close()
    return Spooled(spool.folder)


@pytest.mark.long
def test_a_long_stream_is_decoded_and_stored_without_being_in_memory(tmp_path: Path) -> None:
    """Compare the peaks of memory of sealing 20 s and 320 s of an arm: the rows of the longer one alone would be 100 MB."""
    short, long = (sealed_alone(tmp_path / str(seconds), seconds) for seconds in (20, 320))

    assert long < 1.4 * short


def sealed_alone(folder: Path, seconds: int) -> int:
    """Return the peak of resident memory, in bytes, of a process that seals a spool."""
    store = Store(folder / ".tacpipe")
    store.prepare()
    record(store, seconds, str(folder / "rec"))
    return peaks.bytes_of(folder, "acquire --recover")


def test_a_sealed_stream_has_the_bytes_of_its_table(tmp_path: Path) -> None:
    store = Store(tmp_path / ".tacpipe")
    store.prepare()
    read, rig = record(store, 3), rig_of.parse(RIG)
    sealed = sealing.seal(read, rig)
    with store.at_work():
        appending.append(store, tmp_path / "rec", read, rig, sealed)

    (stored,) = (tmp_path / "rec" / "r").glob("robot.parquet")
    assert stored.read_bytes() == parquet.to_parquet(sealed["robot"].table)
    assert bytes_digest(stored.read_bytes()) in {path.name for path in (tmp_path / ".tacpipe/objects").rglob("*")}


def test_samples_that_came_twice_are_counted_over_all_recordings_of_a_dataset(lab: Lab) -> None:
    rig = rig_of.parse(RIG)
    for repeated in (2, 0, 1):
        spooled = record(lab.store, 1, repeated=repeated)
        with lab.store.at_work():
            appending.append(lab.store, lab.folder / "rec", spooled, rig, sealing.seal(spooled, rig))

    lab.run("label rec r --label material=cork")
    assert lab.run_json("show rec")["counted"] == {
        "stages": {
            "acquire": {
                "results": 3,
                "streams": {"robot": {"read": 3 * BLOCK + 3, "used": 3 * BLOCK, "unused": {"received before": 3}}},
            }
        },
        "uncounted": 0,
    }
