"""Test that acquired datasets are kept, carried, labelled and shown like any other, and that damage is reported."""

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import tacpipe
from tests.conftest import Lab
from tests.recording import live
from tests.test_garbage import age


@pytest.fixture
def acquired(lab: Lab) -> Iterator[Lab]:
    """A lab with two recordings, acquired one after the other, whose rig is still served."""
    with live.served(lab.folder, live.FORCE, live.SKIN):
        for name in ("one", "two"):
            lab.run(f"acquire rig.toml -o rec --duration-s 0.4 --name {name} --label material=cork")
        yield lab


def damage(lab: Lab) -> None:
    """Change a byte of a shard, where it is stored and where it is linked."""
    digest = lab.manifest("rec").recordings["one"]["shards"]["force"]["digest"]
    for path in (lab.folder / ".tacpipe/objects" / digest[:2] / digest, lab.folder / "rec/one/force.parquet"):
        content = path.read_bytes()
        path.chmod(0o644)
        path.unlink()
        path.write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
    for record in lab.store.root.glob("verified/*"):
        record.unlink()


def test_gc_keeps_recordings_even_where_their_dataset_was_deleted(acquired: Lab) -> None:
    before = {name: live.recorded(shard, "force") for name, shard in live.shards(acquired.folder).items()}
    manifest = (acquired.folder / "rec/manifest.json").read_bytes()
    for path in sorted((acquired.folder / "rec").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    age(acquired, days=300)
    for _ in range(2):  # the first look starts the clock of a root that is out of reach
        acquired.run("store gc")
        age(acquired, days=300)
    shards = {name: entry["shards"]["force"]["digest"] for name, entry in json.loads(manifest)["recordings"].items()}

    assert len(before) == 2 and all(acquired.store.read(digest) for digest in shards.values())


def test_gc_leaves_a_spool_that_is_written_alone(acquired: Lab) -> None:
    process = live.started(acquired.folder, "--name three")
    (spool,) = live.awaited(lambda: live.spools(acquired.folder))
    long_ago_s = time.time() - 300 * 86400
    for path in spool.iterdir():
        os.utime(path, (long_ago_s, long_ago_s))
    acquired.run("store gc")
    files = {path.name for path in spool.iterdir()}
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()

    assert files == {"bytes", "header.json", "tally"}
    assert process.returncode == 0, err
    assert list(live.shards(acquired.folder)) == ["one", "three", "two"]


def test_a_spool_that_waits_to_be_recovered_outlives_gc(acquired: Lab) -> None:
    process = live.started(acquired.folder, "--name three")
    live.awaited(lambda: live.spools(acquired.folder))
    process.kill()
    process.communicate()
    age(acquired, days=300)
    acquired.run("store gc")
    acquired.run("acquire --recover")

    assert list(live.shards(acquired.folder)) == ["one", "three", "two"]


def test_damage_to_a_recording_is_told_with_what_brings_it_back(acquired: Lab) -> None:
    remote = acquired.folder.with_name(f"{acquired.folder.name}-remote")
    acquired.run(f"store push {remote} rec")
    damage(acquired)
    for command in ("show rec", "synchronize rec -o grid --rate-hz 50", "store repair"):
        ran = acquired.call(command)
        sentence = (
            "It is the recording one/force.parquet, which cannot be recomputed: restore it with `tacpipe store pull`."
        )
        assert ran.code == 4 and sentence in ran.out + ran.err, command
    acquired.run(f"store pull {remote} rec")

    acquired.run("store verify")
    assert len(live.shards(acquired.folder)["one"].table("force")) > 0


def test_another_recording_can_be_appended_to_a_dataset_with_a_damaged_one(acquired: Lab) -> None:
    damage(acquired)
    acquired.call("acquire rig.toml -o rec --duration-s 0.3 --name three")

    assert "three" in acquired.manifest("rec").recordings and not live.spools(acquired.folder)


def test_an_acquired_dataset_is_pushed_and_pulled(acquired: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    remote = acquired.folder.with_name(f"{acquired.folder.name}-remote")
    acquired.run(f"store push {remote} rec")
    clone = acquired.folder.with_name(f"{acquired.folder.name}-clone")
    (clone / ".tacpipe").mkdir(parents=True)
    monkeypatch.chdir(clone)
    acquired.run(f"store pull {remote} rec")

    assert (clone / "rec/manifest.json").read_bytes() == (acquired.folder / "rec/manifest.json").read_bytes()
    mine, theirs = live.shards(clone), live.shards(acquired.folder)
    assert {name: live.recorded(shard, "skin") for name, shard in mine.items()} == {
        name: live.recorded(shard, "skin") for name, shard in theirs.items()
    }


def test_labels_are_changed_afterwards_and_stay_when_more_is_recorded(acquired: Lab) -> None:
    acquired.run("label rec one --set material=foam --exclude 'the pad fell off'")
    acquired.run("acquire rig.toml -o rec --duration-s 0.3 --name three")
    recordings = acquired.manifest("rec").recordings

    assert [recordings[name]["attributes"].get("material") for name in ("one", "two", "three")] == [
        "foam",
        "cork",
        None,
    ]
    assert recordings["one"]["attributes"]["excluded"] == "the pad fell off"


def test_show_and_explain_tell_of_every_stream(acquired: Lab) -> None:
    show_text = acquired.run("show rec").out
    report = json.loads(acquired.run("show rec --json").out)
    explained = acquired.run("explain rec").out

    rows = {name: shard.table("force").num_rows for name, shard in live.shards(acquired.folder).items()}
    assert {name: streams["force"]["rows"] for name, streams in report["recordings"].items()} == rows
    assert "made by acquire" in show_text and "material: cork (2)" in show_text and "sensor: optoforce (2)" in show_text
    assert "acquire version 1" in explained and "one/rig.toml" in explained


def test_later_stages_read_it(acquired: Lab) -> None:
    acquired.run("synchronize rec -o grid --rate-hz 50")
    grid = tacpipe.open(acquired.folder / "grid")

    assert list(grid.recordings) == ["one", "two"]
    assert Path(acquired.folder / "grid/manifest.json").exists()
