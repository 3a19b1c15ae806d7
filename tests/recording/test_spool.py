"""Test that a spool gives back what was appended, up to where a crash or a disk tore it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.recording import spool_folders
from tacpipe.recording.spool import Spool, Spooled, StreamNote, Tallied
from tacpipe.recording.spool_folders import RecordingHeader
from tacpipe.sensors.framing import Chunks

STREAMS = ["a", "b"]
HEADER: RecordingHeader = {"output": "o", "recording": "r", "attributes": {}, "rig": ""}


def pairs(blocks: list[tuple[str, Chunks | StreamNote]]) -> list[tuple[str, int, bytes]]:
    """Return stream, arrival and bytes of every chunk."""
    return [
        (name, t_ns, packet)
        for name, block in blocks
        if isinstance(block, Chunks)
        for t_ns, packet in zip(block.t_ns.tolist(), block.packets(), strict=True)
    ]


def written_spool(folder: Path, blocks: int = 20) -> tuple[Path, list[tuple[str, int, bytes]]]:
    spool = Spool(folder, HEADER, STREAMS)
    rng = np.random.default_rng(0)
    expected = []
    for number in range(blocks):
        name = STREAMS[number % 2]
        chunks = [(number * 10 + k, rng.bytes(int(rng.integers(0, 40)))) for k in range(3)]
        spool.append(name, Chunks.from_pairs(chunks))
        spool.write()
        expected += [(name, t_ns, data) for t_ns, data in chunks]
    spool.close()
    return spool.folder, expected


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(
    parts=st.lists(
        st.tuples(
            st.sampled_from(STREAMS), st.lists(st.tuples(st.integers(0, 2**62), st.binary(max_size=50)), max_size=5)
        ),
        max_size=8,
    )
)
def test_what_was_appended_is_read_in_its_order(
    tmp_path: Path, parts: list[tuple[str, list[tuple[int, bytes]]]]
) -> None:
    spool = Spool(tmp_path, HEADER, STREAMS)
    for name, chunks in parts:
        spool.append(name, Chunks.from_pairs(chunks))
    spool.note(StreamNote(7, "b", "lost", "unplugged"))
    spool.close()

    read = list(Spooled(spool.folder).blocks())

    assert pairs(read) == [(name, t_ns, data) for name, chunks in parts for t_ns, data in chunks]
    assert read[-1] == ("b", StreamNote(7, "b", "lost", "unplugged"))


def test_a_torn_end_costs_the_block_that_is_torn(tmp_path: Path) -> None:
    folder, expected = written_spool(tmp_path)
    file = folder / "bytes"
    content = file.read_bytes()
    rng = np.random.default_rng(1)
    for cut in rng.integers(1, len(content), 50).tolist():
        file.write_bytes(content[:cut])
        read = Spooled(folder)
        recovered = pairs(list(read.blocks()))
        torn = sum(damage.bytes for damage in read.damage)

        assert recovered == expected[: len(recovered)] and len(recovered) % 3 == 0
        assert torn < 200  # less than one block here


def test_a_flipped_bit_costs_its_block_and_no_other(tmp_path: Path) -> None:
    folder, expected = written_spool(tmp_path)
    file = folder / "bytes"
    content = file.read_bytes()
    rng = np.random.default_rng(2)
    for place in rng.integers(0, len(content), 100).tolist():
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(flipped)
        read = Spooled(folder)
        recovered = pairs(list(read.blocks()))

        assert set(recovered) < set(expected) and len(recovered) == len(expected) - 3
        assert len(read.damage) == 1


def test_zeros_that_a_loss_of_power_left_are_passed_over(tmp_path: Path) -> None:
    folder, expected = written_spool(tmp_path)
    file = folder / "bytes"
    file.write_bytes(file.read_bytes() + bytes(4096))

    read = Spooled(folder)

    assert pairs(list(read.blocks())) == expected
    assert [damage.bytes for damage in read.damage] == [4096]


@pytest.mark.parametrize("first", [False, True])
def test_a_hole_of_a_terabyte_is_passed_over_without_being_read(tmp_path: Path, first: bool) -> None:
    folder, expected = written_spool(tmp_path)
    content = (folder / "bytes").read_bytes()
    with (folder / "bytes").open("r+b") as file:
        if first:  # blocks, a hole, and the same blocks again
            file.seek(1 << 40)
            file.write(content)
        else:
            file.truncate(1 << 40)
    read = Spooled(folder)

    assert pairs(list(read.blocks())) == expected * (2 if first else 1)
    assert sum(damage.bytes for damage in read.damage) == (1 << 40) - len(content)


def test_one_stream_is_read_alone(tmp_path: Path) -> None:
    folder, expected = written_spool(tmp_path)

    assert pairs(list(Spooled(folder).blocks("b"))) == [row for row in expected if row[0] == "b"]


def test_a_spool_that_is_written_is_not_abandoned_and_one_of_a_killed_process_is(tmp_path: Path) -> None:
    spool = Spool(tmp_path, HEADER, STREAMS)
    assert spool_folders.find_abandoned(tmp_path) == []
    spool.close()
    assert spool_folders.find_abandoned(tmp_path) == [spool.folder]
    program = f"""
import time
from pathlib import Path
from tacpipe.recording.spool import Spool
from tacpipe.sensors.framing import Chunks
made = Spool(Path({str(tmp_path)!r}), {HEADER!r}, ["a"])
made.tally(0, 7, 70, 123)
made.append("a", Chunks.from_pairs([(1, b"one"), (2, b"two")]))
made.write()
made.append("a", Chunks.from_pairs([(3, b"three")]))
print("ready", flush=True)
time.sleep(60)
"""
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    assert len(spool_folders.find_abandoned(tmp_path)) == 1
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()

    folder = next(path for path in spool_folders.find_abandoned(tmp_path) if path != spool.folder)
    read = Spooled(folder)

    assert pairs(list(read.blocks())) == [("a", 1, b"one"), ("a", 2, b"two")]
    assert read.tallied() == {"a": Tallied(7, 70, 123)}


def test_a_spool_without_a_header_is_refused_with_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "bytes").touch()
    with pytest.raises(TacpipeError, match="header"):
        Spooled(tmp_path)


def test_stamps_are_mapped_to_utc_by_one_reading_of_both_clocks(tmp_path: Path) -> None:
    before_ns = time.time_ns()
    spool = Spool(tmp_path, HEADER, STREAMS)
    stamp_ns = time.monotonic_ns()
    after_ns = time.time_ns()
    spool.close()

    assert before_ns - 1_000_000 <= Spooled(spool.folder).utc_ns(stamp_ns) <= after_ns + 1_000_000
