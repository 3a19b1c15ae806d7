"""Test that a recording states how it ended and how long it was to last, and keeps its raw bytes on request."""

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from tacpipe.recording import appending
from tacpipe.recording.spool import Spool, Spooled, StreamNote
from tests.conftest import Lab
from tests.recording import live
from tests.recording.scripted import Script
from tests.recording.test_recovering import spooled
from tests.recording.test_schedule import FORCE, RATE_HZ, counts
from tests.test_garbage import age


def describe(lab: Lab) -> tuple[Any, Any, list[tuple[str, str]]]:
    """Return how the only recording ended, what was asked for, and the events of it as a whole."""
    shard = live.only(lab.folder)
    rows = shard.table("events").to_pylist() if "events" in shard.streams else []
    recording_events = [(row["cause"], row["detail"]) for row in rows if not row["stream"]]
    return shard.attributes["ended"], shard.attributes.get("requested_duration_s"), recording_events


def crash_at(lab: Lab, script: Script, at_s: float) -> None:
    """Have the store hold after the next recording what it held at this moment: as if the power had gone then."""
    script.happens.append((at_s, lambda: shutil.copytree(lab.store.root, lab.folder / "then")))


def after_crash(lab: Lab) -> None:
    """Bring back what was there at the moment of `crash_at`."""
    shutil.rmtree(lab.store.root)
    shutil.rmtree(lab.folder / "rec")
    (lab.folder / "then").rename(lab.store.root)


def test_a_recording_that_lasted_as_long_as_asked_is_completed(lab: Lab, script: Script) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 3 --name one")

    assert describe(lab) == ("completed", 3.0, [])
    assert "not completed" not in lab.run("show rec").out


@pytest.mark.parametrize(
    ("options", "number", "expected_end"),
    [
        ("--duration-s 10", signal.SIGINT, "interrupted"),
        ("--duration-s 10", signal.SIGTERM, "interrupted"),
        ("--stop tap --start now", signal.SIGINT, "interrupted"),
        ("", signal.SIGINT, "completed"),  # nothing else ends it
        ("", signal.SIGTERM, "completed"),
        ("", signal.SIGHUP, "interrupted"),
    ],
)
def test_a_recording_that_a_signal_cut_short_is_interrupted(
    lab: Lab, script: Script, options: str, number: signal.Signals, expected_end: str
) -> None:
    if "tap" in options:
        (lab.folder / "rig.toml").write_text(FORCE + live.PROGRAM)
    script.happens.append((4.0, lambda: os.kill(os.getpid(), number)))
    lab.run(f"acquire rig.toml -o rec --name one {options}")
    requested = 10.0 if "duration" in options else None
    request_text = "10 s were requested" if requested else "no duration was requested"
    lasts_s = (counts(live.only(lab.folder))[-1] - counts(live.only(lab.folder))[0]) / RATE_HZ

    events = [] if expected_end == "completed" else [("interrupted", f"{lasts_s:.1f} s are there; {request_text}")]
    assert describe(lab) == (expected_end, requested, events)
    show_text = lab.run("show rec").out
    assert f"ended: {expected_end} (1)" in show_text
    of_requested = " of 10" if requested else ""
    line = f"not completed: one: interrupted before its end, {lasts_s:.1f}{of_requested} s"
    assert (line in show_text) == (expected_end == "interrupted")


def test_a_recording_that_a_loss_of_power_cut_short_is_recovered(lab: Lab, script: Script) -> None:
    crash_at(lab, script, 5.0)
    lab.run("acquire rig.toml -o rec --duration-s 10 --name one")
    after_crash(lab)
    lab.run("acquire --recover")
    lasts_s = (len(counts(live.only(lab.folder))) - 1) / RATE_HZ

    assert 4.8 < lasts_s < 5
    assert describe(lab) == ("recovered", 10.0, [("recovered", f"{lasts_s:.1f} s are there; 10 s were requested")])
    line = f"not completed: one: recovered after a crash or a power failure, {lasts_s:.1f} of 10 s"
    assert line in lab.run("show rec").out.splitlines()


def test_a_recording_that_ended_and_was_sealed_by_another_process_is_whole_and_says_so(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: Any) -> str:
        raise OSError("the power is gone")

    with monkeypatch.context() as patch:
        patch.setattr(appending, "append", fail)
        assert lab.call("acquire rig.toml -o rec --duration-s 3 --name one").code == 1
    lab.run("acquire --recover")

    assert describe(lab) == ("completed", 3.0, [])


def test_what_a_label_says_of_the_end_of_a_recording_counts_for_nothing(lab: Lab, script: Script) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 3 --name one --label ended=never")

    assert describe(lab)[0] == "completed"


def test_a_spool_of_before_is_recovered_without_a_word_on_its_duration(lab: Lab) -> None:
    folder = spooled(lab)  # its header has no `duration_s` and no `keep`, and an absolute path

    assert not {"duration_s", "keep"} & set(Spooled(folder).header)
    lab.run("acquire --recover")
    assert describe(lab) == ("recovered", None, [("recovered", "0.1 s are there; no duration was requested")])


@pytest.mark.parametrize("duration_s", ["3", float("inf"), [3]])
def test_a_duration_that_is_no_number_is_refused(lab: Lab, duration_s: Any) -> None:
    folder = spooled(lab)
    header = {**json.loads((folder / "header.json").read_text()), "duration_s": duration_s}
    (folder / "header.json").write_text(json.dumps(header))

    assert "Its duration is " in lab.call("acquire --recover").err


def test_a_note_on_the_recording_is_read_with_any_stream_and_given_out_with_none(tmp_path: Path) -> None:
    spool = Spool(tmp_path, {"rig": ""}, ["a", "b"])
    spool.note(StreamNote(1, "b", "lost", "unplugged"))
    spool.note(StreamNote(2, "", "ended", "interrupted"))
    spool.close()
    read = Spooled(spool.folder)

    assert read.ended == "recovered"  # nothing is read yet
    assert list(read.blocks("a")) == [] and read.ended == "interrupted" and not read.damage
    assert list(read.blocks()) == [("b", StreamNote(1, "b", "lost", "unplugged"))]


def kept_spool(lab: Lab, err: str) -> Path:
    """Return where a command says that it kept a spool."""
    (path,) = (lab.store.root / "kept-spools").iterdir()
    assert err.endswith(f"; its spool was moved to {path}\n")
    assert sorted(file.name for file in path.iterdir()) == ["bytes", "header.json", "tally"]
    return path


@pytest.mark.parametrize("crashed", [False, True])
def test_a_spool_is_kept_where_asked_for_and_no_collection_removes_it(lab: Lab, script: Script, crashed: bool) -> None:
    crash_at(lab, script, 2.5)
    ran = lab.run("acquire rig.toml -o rec --duration-s 3 --name one --keep-spool")
    if crashed:
        after_crash(lab)
        ran = lab.run("acquire --recover")
    path = kept_spool(lab, ran.err)
    content = (path / "bytes").read_bytes()
    age(lab, days=300)
    lab.run("store gc --recordings")
    lab.run("acquire --recover")

    assert (path / "bytes").read_bytes() == content and list(live.shards(lab.folder)) == ["one"]
    before = counts(live.only(lab.folder))
    shutil.move(
        path, lab.store.root / "spool" / path.name
    )  # The page howto/record.md states that this decodes it once more.
    lab.run("acquire --recover")
    assert list(live.shards(lab.folder)) == ["one"] and counts(live.only(lab.folder)) == before


def test_a_spool_is_not_kept_unasked(lab: Lab, script: Script) -> None:
    lab.run("acquire rig.toml -o rec --duration-s 1 --name one")

    assert not (lab.store.root / "kept-spools").exists() and not live.spools(lab.folder)
