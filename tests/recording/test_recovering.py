"""Test that the spool of a crash or a full disk is sealed later, once, and its losses are reported."""

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.recording import appending, spool_folders
from tacpipe.recording import rig as rig_of
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.sealing import seal
from tacpipe.recording.spool import Spool, Spooled
from tacpipe.recording.spool_folders import RecordingHeader
from tacpipe.sensors.framing import Chunks
from tacpipe.store import store as store_of
from tests.conftest import Lab, without_created_store
from tests.emulation.emulator import Emulator
from tests.promises import counts
from tests.recording import killing, live
from tests.recording.test_reading import SENSOR, frames

RIG = live.stream("force", "optoforce", "serial:/dev/there-is-none", "{ axes = 3 }")
PERIOD_NS = 1_000_000


def spooled(lab: Lab, name: str = "one", text: str = RIG, unread: int = 0, count: int = 100) -> Path:
    """Write a spool as a process leaves it that was killed, ``unread`` chunks short of what it had received."""
    header: RecordingHeader = {
        "output": str(lab.folder / "rec"),
        "recording": name,
        "attributes": {"material": "cork"},
        "rig": text,
    }
    spool = Spool(lab.folder / ".tacpipe", header, ["force"])
    sent = [(row * PERIOD_NS, frame) for row, frame in enumerate(frames(count))]
    size = sum(len(frame) for _, frame in sent)
    spool.tally(0, count, size, sent[-1][0])
    if sent[: count - unread]:
        spool.append("force", Chunks.from_pairs(sent[: count - unread]))
    spool.close()
    return spool.folder


def _is_spool(handle: int) -> bool:
    return Path(f"/proc/self/fd/{handle}").readlink().name == "bytes"


def seqs(lab: Lab) -> dict[str, list[int]]:
    """Return the counter of each recording of the dataset."""
    return {name: shard.table("force").column("seq").to_pylist() for name, shard in live.shards(lab.folder).items()}


@pytest.mark.rig
@pytest.mark.parametrize(
    "after_s", [(1.0,), pytest.param(np.linspace(0.0, 3.2, 17).tolist(), marks=pytest.mark.faults)], ids=["one", "many"]
)
def test_of_killed_recordings_all_that_was_written_is_recovered_and_told_what_was_read_and_not_written(
    after_s: Sequence[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACPIPE_STORE", str(tmp_path / "store"))
    with killing.emulated(tmp_path) as emulator:
        costs_by_kill = [killing.kill(emulator, tmp_path, one_s, 3.0, after_first_bytes=True) for one_s in after_s]
        costs = [cost for kill_costs in costs_by_kill for cost in kill_costs or []]

        assert costs, "no recording had begun when it was killed"
        assert all(cost.recovered > 0 for cost in costs)
        assert all(cost.unread >= 0 for cost in costs)  # the reported loss is at most what was sent and is missing
        counts.count("kills survived", len(after_s))


def test_what_was_read_and_never_written_is_told(lab: Lab) -> None:
    spooled(lab, unread=7)
    lab.run("acquire --recover")
    shard = live.only(lab.folder)

    assert seqs(lab) == {"one": list(range(93))}
    events = {event["cause"]: event for event in shard.table("events").to_pylist()}
    assert set(events) == {"crash", "recovered"}
    assert (events["crash"]["stream"], events["crash"]["bytes"]) == ("force", 7 * 16)
    attributes = {
        name: shard.attributes[name] for name in ("force_crash_lost_reads", "force_crash_lost_bytes", "material")
    }
    assert attributes == {"force_crash_lost_reads": 7, "force_crash_lost_bytes": 112, "material": "cork"}


def test_what_came_before_the_trigger_counts_as_read(lab: Lab, rig: Emulator) -> None:
    parsed_rig = rig_of.read(lab.folder / "rig.toml")
    recorder, store = Recorder(parsed_rig), lab.folder / ".tacpipe"
    with recorder.open():
        recorder.run(lambda: recorder.watches["force"].samples > 150)
        spool = Spool(store, {"output": "", "recording": "", "attributes": {}, "rig": ""}, ["force"])
        with recorder.recording(spool, preroll=True):
            recorder.run(lambda: recorder.watches["force"].samples > 250)
        spool.close()
    sealed = seal(Spooled(spool.folder), parsed_rig)["force"]
    chunks = sum(len(block.size) for _, block in Spooled(spool.folder).blocks() if isinstance(block, Chunks))

    assert sealed.table.num_rows > 100 and sealed.crashed == (0, 0)
    assert Spooled(spool.folder).tallied()["force"].chunks == chunks


def test_recovering_twice_does_nothing_the_second_time(lab: Lab) -> None:
    spooled(lab)
    first = lab.run("acquire --recover --json")
    manifest = (lab.folder / "rec/manifest.json").read_bytes()
    second = lab.run("acquire --recover --json")

    assert [recording["name"] for recording in json.loads(first.out)["recordings"]] == ["one"]
    assert json.loads(second.out)["recordings"] == [] and second.err == ""
    assert (lab.folder / "rec/manifest.json").read_bytes() == manifest and not live.spools(lab.folder)


def test_the_next_recording_recovers_first(lab: Lab, rig: Emulator) -> None:
    spooled(lab, "before")
    ran = lab.run("acquire rig.toml -o rec --duration-s 0.3 --name after")

    assert without_created_store(ran.err).splitlines()[0] == "recovered before: 0.1 s, force 100 samples"
    assert list(live.shards(lab.folder)) == ["after", "before"]


def test_a_process_that_was_killed_after_it_published_is_not_appended_twice(lab: Lab) -> None:
    folder = spooled(lab)
    backup = lab.folder / "kept"
    shutil.copytree(folder, backup)
    lab.run("acquire --recover")
    manifest = (lab.folder / "rec/manifest.json").read_bytes()
    shutil.copytree(backup, folder)
    ran = lab.run("acquire --recover")

    assert ran.err == "recovered one: 0.1 s, force 100 samples\n"
    assert (lab.folder / "rec/manifest.json").read_bytes() == manifest and not live.spools(lab.folder)


def test_a_spool_whose_parsed_rig_no_longer_parses_stays_and_is_told(lab: Lab) -> None:
    stays = spooled(lab, "old", text=RIG.replace("axes", "axles"))
    spooled(lab, "new")
    for _ in range(2):
        ran = lab.call("acquire --recover")
        line = next(printed for printed in ran.err.splitlines() if printed.startswith("tacpipe: "))

        assert ran.code == 1 and stays.exists()
        assert (
            line.startswith(f"tacpipe: The spool {stays} was not sealed. The rig file in {stays}") and "axles" in line
        )
    assert list(live.shards(lab.folder)) == ["new"]


def test_a_spool_with_half_a_header_keeps_nobody_from_recording(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    stays = spooled(lab, "old")
    header = json.loads((stays / "header.json").read_text())
    del header["clock"]
    (stays / "header.json").write_text(json.dumps(header))
    ran = lab.run("acquire rig.toml -o rec --duration-s 0.3 --name new")

    assert f"The spool {stays} was not sealed. Its clock is None" in ran.err
    assert list(live.shards(lab.folder)) == ["new"] and stays.exists()


def test_a_spool_without_a_sample_is_no_recording(lab: Lab) -> None:
    folder = spooled(lab, unread=100)
    lab.store.prepare()
    ran = lab.run("acquire --recover")

    assert not folder.exists() and not (lab.folder / "rec").exists() and ran.err == ""


def test_a_spool_that_was_begun_and_has_no_header_is_removed_when_it_is_old(lab: Lab) -> None:
    folder = lab.folder / ".tacpipe/spool" / ("0123" * 8)
    folder.mkdir(parents=True)
    (folder / "bytes").touch()
    lab.run("acquire --recover")
    assert folder.exists()  # it may be one that a process is about to begin

    os.utime(folder / "bytes", (0, 0))
    lab.run("acquire --recover")
    assert not folder.exists()


def test_a_spool_that_is_being_sealed_is_left_to_the_process_that_does_it(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed = []
    real = appending.append

    def append(store: store_of.Store, *args: Any) -> str:
        observed.append((live.spools(lab.folder), spool_folders.find_abandoned(store.root)))
        return real(store, *args)

    monkeypatch.setattr(appending, "append", append)
    lab.run("acquire rig.toml -o rec --duration-s 0.3")

    ((spools, abandoned),) = observed
    assert len(spools) == 1 and abandoned == []


def test_a_spool_that_another_process_holds_is_not_recovered(lab: Lab) -> None:
    folder = spooled(lab)
    with (folder / "bytes").open("rb") as spool_file:
        fcntl.flock(spool_file, fcntl.LOCK_EX)
        assert json.loads(lab.run("acquire --recover --json").out)["recordings"] == []
    assert json.loads(lab.run("acquire --recover --json").out)["rows"] == 100


def test_a_disk_that_is_full_while_it_records_ends_it_with_a_sentence_and_what_came_is_recovered(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write

    def full(handle: int, data: Any) -> int:
        if _is_spool(handle) and os.fstat(handle).st_size > 3000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(handle, data[:1000] if _is_spool(handle) else data)  # the last write gets as far as it can

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        ran = lab.call("acquire rig.toml -o rec --name one")
    (folder,) = live.spools(lab.folder)

    assert ran.code == 1 and not (lab.folder / "rec").exists()
    assert without_created_store(ran.err) == (
        f"tacpipe: The disk accepts no more data of the recording (No space left on device), so it ended. The data so "
        f"far are in {folder}; free some space, and `tacpipe acquire --recover` seals it.\n"
    )
    assert lab.run("acquire --recover").err.startswith("recovered one: ")
    rows = live.recorded(live.only(lab.folder), "force")
    assert len(rows) > 50
    live.place(rows, live.sent(rig, "force"))


def test_a_disk_that_is_full_while_it_seals_keeps_the_spool_and_it_is_recovered(
    lab: Lab, rig: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write

    def full(handle: int, data: Any) -> int:
        if os.fstat(handle).st_size + len(data) > 2000 and not _is_spool(handle):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(handle, data)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        ran = lab.call("acquire rig.toml -o rec --duration-s 1 --name one")
    (folder,) = live.spools(lab.folder)

    assert ran.code == 1 and not (lab.folder / "rec").exists()
    err = without_created_store(ran.err)
    assert err.startswith("tacpipe: The disk under ") and err.count("\n") == 1
    sentence = f"The recorded data is in {folder}; `tacpipe acquire --recover` seals it once that is fixed.\n"
    assert err.endswith(sentence)
    lab.run("acquire --recover")
    live.place(live.recorded(live.only(lab.folder), "force"), live.sent(rig, "force"))
    assert not live.spools(lab.folder)


def test_what_a_driver_makes_of_a_spool_is_what_was_sent(lab: Lab) -> None:
    spooled(lab, count=50)
    lab.run("acquire --recover")

    sent = SENSOR.decode(np.frombuffer(b"".join(frames(50)), "u1").reshape(50, 16))
    columns = [column.tolist() for block in sent.values for column in block.T]
    assert live.recorded(live.only(lab.folder), "force") == [repr(row) for row in zip(*columns, strict=True)]
