"""Test that a failure during a recording neither ends other streams nor loses earlier samples."""

import errno
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.links.link import LinkLostError
from tacpipe.recording import clock, sealing, station, triggers
from tacpipe.recording import rig as rig_of
from tacpipe.recording.losses import StreamLosses
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.spool import Spool, Spooled, StreamNote
from tacpipe.recording.spool_folders import RecordingHeader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import LocalAddress, Samples
from tests.conftest import Lab

RIG = """
[[stream]]
name = "a"
sensor = "optoforce"
transport = "serial:/dev/a"
options = { axes = 3 }

[[stream]]
name = "b"
sensor = "optoforce"
transport = "serial:/dev/b"
options = { axes = 3 }
"""
PERIOD_NS = 1_000_000


def frames(count: int) -> list[bytes]:
    values = (np.zeros((count, 1), np.uint16), np.arange(3 * count).reshape(count, 3).astype(np.int16))
    return [bytes(frame) for frame in OptoForce(axes=3).encode(Samples(values, seq=np.arange(count)))]


def chunks(rows: range, all_frames: list[bytes], since_ns: int = 0) -> Chunks:
    return Chunks.from_pairs([(since_ns + row * PERIOD_NS, all_frames[row]) for row in rows])


def spooled(folder: Path, **streams: list[Chunks | StreamNote]) -> Spooled:
    spool = Spool(folder, {"rig": RIG, "output": "rec", "recording": "r", "attributes": {}}, list(streams))
    for name, blocks in streams.items():
        count = size = 0
        for block in blocks:
            if isinstance(block, StreamNote):
                spool.note(block)
                continue
            spool.append(name, block)
            count, size = count + len(block.size), size + len(block.data)
            spool.tally(spool.streams[name], count, size, int(block.t_ns[-1]))
    spool.close()
    return Spooled(spool.folder)


class Link:
    """A link that gives the items of a list and raises those that are errors."""

    packets, overruns, foreign, kernel_stamped = False, 0, 0, False
    local: LocalAddress = {}  # noqa: RUF012

    def __init__(self, incoming: list[Any], closing: Exception | None = None, pace_s: float = 0.0) -> None:
        self.incoming, self.closing, self.pace_s = incoming, closing, pace_s

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        if not self.incoming:
            time.sleep(0.01)
            return []
        time.sleep(self.pace_s)
        item = self.incoming.pop(0)
        if isinstance(item, Exception):
            raise item
        return [(time.monotonic_ns(), item)]

    def write(self, data: bytes) -> None:
        return None

    def close(self) -> None:
        if self.closing is not None:
            raise self.closing


def opened(monkeypatch: pytest.MonkeyPatch, links: dict[str, list[Link]]) -> Recorder:
    def open_link(address: Any, sensor: Any, name: str) -> Link:
        if not links[name]:
            raise LinkLostError(f"Stream {name} is not there.")
        return links[name].pop(0)

    monkeypatch.setattr("tacpipe.links.opening.open_link", open_link)
    return Recorder(rig_of.parse(RIG))


def until(condition: Any, recorder: Recorder) -> None:
    deadline_s = time.monotonic() + 300
    recorder.run(lambda: condition() or time.monotonic() > deadline_s)
    assert condition()


def test_a_link_that_cannot_even_be_closed_is_lost_told_and_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = frames(100)
    broken = Link([b"".join(sent[:50]), LinkLostError("gone")], closing=RuntimeError("capture"))
    recorder = opened(monkeypatch, {"a": [broken, Link([b"".join(sent[50:])])], "b": [Link([])]})

    with recorder.open():
        until(lambda: recorder.watches["a"].samples == 100, recorder)

    assert recorder.stations["a"].error is None


def test_a_driver_that_fails_ends_no_recording_and_other_streams_are_sealed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = frames(300)
    decode = OptoForce.decode

    def fail(self: OptoForce, batch: Any) -> Samples:
        samples = decode(self, batch)
        if fail_on[0] and np.any(samples.seq == 150):
            raise RuntimeError("no sense")
        return samples

    fail_on = [True]
    monkeypatch.setattr(OptoForce, "decode", fail)
    recorder = opened(monkeypatch, {"a": [Link(list(sent), pace_s=0.003)], "b": [Link([])]})
    header: RecordingHeader = {"rig": RIG, "output": "", "recording": "r", "attributes": {}}
    with recorder.open():
        spool = Spool(tmp_path, header, ["a", "b"])
        with recorder.recording(spool):
            until(lambda: recorder.watches["a"].error != "", recorder)
            until(lambda: not recorder.stations["a"]._link.incoming, recorder)  # type: ignore[union-attr]
        spool.close()

    sealed = sealing.seal(Spooled(spool.folder), rig_of.parse(RIG))["a"]

    assert sealed.received > 200 * 16  # it has the bytes that came after the driver failed
    assert sealed.undecoded and [event.cause for event in sealed.events].count(sealing.UNDECODED) == 1
    fail_on[0] = False
    resealed_table = sealing.seal(Spooled(spool.folder), rig_of.parse(RIG))["a"].table
    assert resealed_table.num_rows == sealed.received // 16 and resealed_table.column("seq")[-1].as_py() == 299


def test_a_stream_that_falls_silent_before_the_end_says_so(tmp_path: Path) -> None:
    sent = frames(4000)
    read = spooled(tmp_path, a=[chunks(range(1000), sent)], b=[chunks(range(4000), sent)])

    sealed = sealing.seal(read, rig_of.parse(RIG))

    assert [(event.cause, event.frames) for event in sealed["a"].events] == [("silent", 3000)]
    assert sealed["a"].losses == StreamLosses(estimated=3000) and sealed["a"].lost == 0 and not sealed["b"].events


def test_a_stream_that_was_lost_when_the_recording_began_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorder = opened(monkeypatch, {"a": [Link([LinkLostError("unplugged")])], "b": [Link([])]})
    with recorder.open():
        until(lambda: recorder.stations["a"].error is not None, recorder)
        spool = Spool(tmp_path, {"rig": RIG}, ["a", "b"])
        with recorder.recording(spool):
            pass
        spool.close()

    notes = [block for _, block in Spooled(spool.folder).blocks("a") if isinstance(block, StreamNote)]
    assert [note.what for note in notes] == [station.LOST]


def test_what_is_recorded_before_a_trigger_arrived_within_half_a_second(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorder = opened(monkeypatch, {"a": [Link([])], "b": [Link([])]})
    now_ns = time.monotonic_ns()
    monkeypatch.setattr(clock, "now_ns", lambda: now_ns)
    sent = frames(3000)
    # three seconds in one block, as while a trial is sealed
    late = chunks(range(3000), sent, now_ns - 3000 * PERIOD_NS)
    recorder._watch("a", [late])
    spool = Spool(tmp_path, {"rig": RIG}, ["a", "b"])
    with recorder.recording(spool, preroll=True):
        pass
    spool.close()

    (block,) = [block for _, block in Spooled(spool.folder).blocks("a") if isinstance(block, Chunks)]
    assert len(block.size) == 500 and int(block.t_ns[-1]) == int(late.t_ns[-1])


def test_a_disk_that_fails_a_sync_ends_the_recording_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    spool = Spool(tmp_path, {"rig": RIG}, ["a"])

    def fail(handle: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fail)
    spool.sync()
    spool.append("a", chunks(range(2), frames(2)))
    with pytest.raises(TacpipeError, match=r"Input/output error.*--recover"):
        spool.write()
    monkeypatch.undo()
    spool.failed = None
    spool.close()


def test_bytes_of_which_no_sample_comes_are_not_removed(lab: Lab) -> None:
    noise = Chunks.from_pairs([(row, os.urandom(50)) for row in range(100)])
    folder = spooled(lab.folder / ".tacpipe", a=[noise], b=[]).folder

    ran = lab.call("acquire --recover")

    assert ran.code == 1 and "5,000 bytes" in ran.err and str(folder) in ran.err
    assert (folder / "bytes").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("labels = 3\n" + RIG, "labels is 3"),
        ("[labels]\nx = nan\n" + RIG, "label x is nan"),
        ("master = ['a']\n" + RIG, "the master is"),
        (RIG + "emulate = 3\n", "emulate is 3"),
        (RIG.replace("{ axes = 3 }", "3"), "options is 3"),
        ("", "lists no stream"),
        ("stream = 3", "lists no stream"),
        ("a = [", "not valid TOML"),
        (RIG.replace('"b"', '"a"', 1), "two streams named a"),
        (RIG.replace('"a"', '"events"', 1), "is not a valid stream name"),
        (RIG.replace("optoforce", "optoforte", 1), "no sensor optoforte"),
        (RIG.replace("axes", "axis", 1), "no option axis"),
        (RIG.replace("serial:", "ws:", 1), "cannot be reached by"),
        (RIG.replace("serial:", "parallel:", 1), "parallel:.* address of a device"),
        (RIG.replace("options", "optoins", 1), "no key optoins"),
    ],
)
def test_a_rig_file_that_is_wrong_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        rig_of.parse(text)


def test_a_key_that_nobody_can_press_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as devnull:
        monkeypatch.setattr("sys.stdin", devnull)
        with triggers.watch_keys() as pressed:
            assert pressed() is False
            with pytest.raises(UsageError):
                pressed(must=True)


def test_what_arrived_before_the_end_is_recorded_though_it_is_read_after_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sent = frames(3)
    is_reading, has_ended = threading.Event(), threading.Event()

    class Late(Link):
        """A link whose last packet waits in the system while the reader lingers."""

        def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
            if len(self.incoming) == 1 and not has_ended.is_set():
                arrival_ns = time.monotonic_ns()
                is_reading.set()
                has_ended.wait(300)
                return [(arrival_ns, self.incoming.pop())]
            return super().read(timeout_s)

    recorder = opened(monkeypatch, {"a": [Late(list(sent))], "b": [Link([])]})
    sleep = clock.sleep

    def end_and_sleep(pause_s: float) -> None:
        has_ended.set()
        sleep(pause_s)

    with recorder.open():
        spool = Spool(tmp_path, {"rig": RIG}, ["a", "b"])
        with recorder.recording(spool, preroll=True):
            until(is_reading.is_set, recorder)
            monkeypatch.setattr(clock, "sleep", end_and_sleep)
        spool.close()
    sealed = sealing.seal(Spooled(spool.folder), rig_of.parse(RIG))["a"]

    assert sealed.table.column("seq").to_pylist()[-1] == 2
