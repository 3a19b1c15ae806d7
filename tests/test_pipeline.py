import json
import re
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pyarrow as pa
import pytest

import tacpipe
from tacpipe.datasets import directory
from tacpipe.datasets.dataset import Recording
from tacpipe.datasets.manifest import Manifest
from tacpipe.engine import provenance
from tacpipe.io.hashing import digest, file_digest
from tacpipe.io.parquet import to_parquet
from tacpipe.store.records import RecordingEntry, digests
from tests.conftest import Lab, write_source
from tests.fake_recordings import stored_entry


def counts(printed: str) -> tuple[int, int]:
    value = json.loads(printed)
    return value["ran"], value["reused"]


def replace_stream(lab: Lab, path: str, recording: str, stream: str, table: pa.Table) -> None:
    """Give one stream of a recording other content, as a rig does that records it anew."""
    manifest = lab.manifest(path)
    entry = manifest.recordings[recording]
    shards = {**entry["shards"], **stored_entry(lab.store, {stream: table}, {})["shards"]}
    recordings: dict[str, RecordingEntry] = {**manifest.recordings, recording: {**entry, "shards": shards}}
    changed = Manifest(manifest.stage, manifest.version, manifest.params, recordings=recordings)
    lab.store.put(changed.content)
    directory.publish(lab.store, changed, lab.folder / path)


def test_a_chain_gives_what_the_functions_give(lab: Lab) -> None:
    lab.run("simulate toy --trials 3 --rows 5 -o data/r")
    lab.run("scale data/r -o data/s --factor 10")
    lab.run("total data/s -o data/t")
    values = tacpipe.open("data/s").to_numpy()["trial-002"].values
    assert values[:, 0].tolist() == [0, 30, 60, 90, 120]
    assert json.loads(Path("data/t/metrics.json").read_text()) == {
        "trial-000": 100,
        "trial-001": 200,
        "trial-002": 300,
    }


def test_a_rerun_does_nothing_and_leaves_every_file_as_it_was(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    before = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in Path("data").rglob("*") if path.is_file()}
    assert counts(lab.run("simulate toy -o data/r --json").out) == (0, 4)
    assert counts(lab.run("scale data/r -o data/s --json").out) == (0, 4)
    after = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in Path("data").rglob("*") if path.is_file()}
    assert after == before


def test_a_new_recording_costs_one_recording(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 5")
    lab.run("scale data/r -o data/s")
    manifest = lab.manifest("data/r")
    fewer = {name: entry for name, entry in manifest.recordings.items() if name != "trial-004"}
    small = Manifest(manifest.stage, manifest.version, manifest.params, recordings=fewer)
    lab.store.put(small.content)
    directory.publish(lab.store, small, Path("data/few"))
    lab.run("scale data/few -o data/sf --factor 7")
    assert counts(lab.run("scale data/r -o data/sf --factor 7 --json").out) == (1, 4)


def test_a_changed_recording_costs_one_recording_and_equal_bytes_stop_the_chain(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 6")
    lab.run("scale data/r -o data/s")
    lab.run("total data/s -o data/t")
    replace_stream(lab, "data/r", "trial-002", "right", pa.table({"y": [1, 2]}))
    assert counts(lab.run("scale data/r -o data/s --json").out) == (1, 5)
    assert counts(lab.run("total data/s -o data/t --json").out) == (0, 1)
    replace_stream(lab, "data/r", "trial-002", "left", pa.table({"x": pa.array([4], pa.uint16())}))
    assert counts(lab.run("scale data/r -o data/s --json").out) == (1, 5)
    assert counts(lab.run("total data/s -o data/t --json").out) == (1, 0)


def test_two_recordings_of_the_same_content_are_computed_once_each_and_named_apart(lab: Lab) -> None:
    write_source("src", a="1 2 3", b="1 2 3")
    lab.run("ingest numbers src -o data/r")
    lab.run("scale data/r -o data/s --jobs 1")
    manifest = lab.manifest("data/s")
    assert manifest.recordings["a"]["shards"] == manifest.recordings["b"]["shards"]


def test_a_label_reruns_only_what_reads_it(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("named data/r -o data/n")
    lab.run("total data/s -o data/t")
    lab.run("label data/r trial-001 --set material=foam")
    assert counts(lab.run("scale data/r -o data/s --json").out) == (0, 4)
    assert counts(lab.run("named data/r -o data/n --json").out) == (1, 3)
    assert counts(lab.run("total data/s -o data/t --json").out) == (1, 0)
    assert lab.manifest("data/s").recordings["trial-001"]["attributes"]["material"] == "foam"
    assert lab.manifest("data/n").recordings["trial-001"]["attributes"]["seen"] == "foam"


def test_labels_survive_a_new_ingest_and_excluded_recordings_are_left_out(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("label data/r trial-00[01] --exclude dropped")
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    assert sorted(lab.manifest("data/s").recordings) == ["trial-002", "trial-003"]
    assert "dropped" in lab.run("show data/r").out
    lab.run("label data/r trial-000 --include")
    lab.run("scale data/r -o data/s")
    assert sorted(lab.manifest("data/s").recordings) == ["trial-000", "trial-002", "trial-003"]
    assert not Path("data/s/trial-001.parquet").exists()


def test_a_fit_sees_training_recordings_alone_and_a_new_test_recording_never_refits(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 4 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    lab.run("halves data/s -o data/split")
    lab.run("centre data/s --split data/split -o data/c")
    assert Path("data/c/codec.json").read_text() == "1.500000"  # 0 1 2 and 0 2 4
    fits = [key for key, record in lab.store.records() if record["identity"].get("stage") == "centre.fit"]
    replace_stream(lab, "data/r", "trial-003", "left", pa.table({"x": pa.array([9], pa.uint16())}))
    lab.run("scale data/r -o data/s --factor 1")
    assert counts(lab.run("centre data/s --split data/split -o data/c --json").out) == (1, 3)
    assert [key for key, record in lab.store.records() if record["identity"].get("stage") == "centre.fit"] == fits
    replace_stream(lab, "data/r", "trial-000", "left", pa.table({"x": pa.array([8], pa.uint16())}))
    lab.run("scale data/r -o data/s --factor 1")
    assert counts(lab.run("centre data/s --split data/split -o data/c --json").out) == (4, 0)


def test_a_fitted_codec_can_be_applied_to_other_recordings(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 4 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    lab.run("halves data/s -o data/split")
    lab.run("centre data/s --split data/split -o data/c")
    lab.run("simulate toy -o data/r2 --trials 1 --rows 3 --offset 5")
    lab.run("scale data/r2 -o data/s2 --factor 1")
    lab.run("centre data/s2 --codec data/c -o data/c2")
    assert tacpipe.open("data/c2").to_numpy()["trial-000"].values[:, 0].tolist() == [3.5, 4.5, 5.5]


def test_several_datasets_are_read_as_one_if_names_are_unique(lab: Lab) -> None:
    write_source("src1", a="1")
    write_source("src2", b="2")
    lab.run("ingest numbers src1 -o data/r1")
    lab.run("ingest numbers src2 -o data/r2")
    lab.run("scale data/r1 data/r2 -o data/s")
    assert sorted(lab.manifest("data/s").recordings) == ["a", "b"]
    failed = lab.call("scale data/r1 data/r1 -o data/s2")
    assert failed.code == 2 and "recording named a" in failed.err and not Path("data/s2").exists()


def test_one_bad_recording_is_named_the_good_ones_are_kept_and_can_be_gone_on_with(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 3 --offset 7")
    replace_stream(lab, "data/r", "trial-001", "left", pa.table({"x": pa.array([3], pa.uint16())}))
    failed = lab.call("scale data/r -o data/s --refuse 3")
    assert failed.code == 1 and "trial-001" in failed.err and "begins with 3" in failed.err
    assert not Path("data/s").exists()
    ran = lab.run("scale data/r -o data/s --refuse 3 --skip-bad --json")
    assert json.loads(ran.out)["bad"] == {"trial-001": "It begins with 3, which this stage refuses."}
    assert counts(ran.out) == (0, 2)
    assert lab.manifest("data/s").skipped == {"trial-001": "It begins with 3, which this stage refuses."}


def test_a_damaged_object_is_made_again_through_the_whole_chain(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("total data/s -o data/t")
    totals = Path("data/t/metrics.json").read_bytes()
    for path in lab.store.root.glob("objects/*/*"):
        if path.read_bytes()[:4] == b"PAR1":
            path.chmod(0o644)
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 0x10
            path.write_bytes(content)
    assert counts(lab.run("total data/s -o data/t2 --json").out) == (0, 1)
    lab.run("scale data/r -o data/s3 --factor 3")
    lab.run("total data/s3 -o data/t3")
    sums = json.loads(Path("data/t3/metrics.json").read_text())
    assert sums == {name: value * 3 // 2 for name, value in json.loads(totals).items()}


def test_damage_to_a_recording_that_cannot_be_made_again_is_said_so_unless_its_copy_is_sound(lab: Lab) -> None:
    write_source("src", a="1 2 3")
    lab.run("ingest numbers src -o data/r")
    (stored,) = (shard["digest"] for shard in lab.manifest("data/r").recordings["a"]["shards"].values())
    path = Path(lab.store.object_path(stored))
    path.chmod(0o644)
    path.write_bytes(b"X" + path.read_bytes()[1:])
    assert tacpipe.open("data/r").to_numpy("left")["a"].values.tolist() == [[1], [2], [3]]  # adopted from data/r
    for copy in (path, Path("data/r/a/left.parquet")):
        copy.chmod(0o644)
        copy.write_bytes(b"X" + copy.read_bytes()[1:])
    failed = lab.call("scale data/r -o data/s")
    assert failed.code == 4 and "store pull" in failed.err and "a/left.parquet" in failed.err


def test_a_hit_on_a_missing_object_reruns_that_shard(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    manifest = lab.manifest("data/s")
    Path(lab.store.object_path(manifest.recordings["trial-002"]["shards"][""]["digest"])).unlink()
    assert counts(lab.run("scale data/r -o data/s --json").out) == (1, 3)
    assert lab.manifest("data/s") == manifest


def test_files_beside_the_manifest_are_never_trusted(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 2")
    lab.run("scale data/r -o data/s --factor 1")
    stale = Path("data/s/trial-000.parquet")
    stale.unlink()
    stale.write_bytes(to_parquet(pa.table({"x": [99]})))
    assert tacpipe.open("data/s").to_numpy()["trial-000"].values.tolist() == [[0], [1]]
    lab.run("store link data/s")
    assert file_digest(stale) == lab.manifest("data/s").recordings["trial-000"]["shards"][""]["digest"]


def test_a_rerun_links_anew_what_does_not_match_though_it_has_the_same_size(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 2")
    lab.run("scale data/r -o data/s --factor 1")
    for path in (Path("data/s/trial-000.parquet"), Path("data/r/trial-000/left.parquet")):
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content[:-9] + b"?" + content[-8:])
        lab.run("simulate toy -o data/r --trials 1 --rows 2")
        lab.run("scale data/r -o data/s --factor 1")
        assert path.read_bytes() == content


def test_a_dataset_copied_without_its_store_opens_and_is_adopted(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/r --trials 2")
    monkeypatch.setenv("TACPIPE_STORE", str(lab.folder / "other"))
    lab.run("scale data/r -o data/s")
    lab.run("store verify")
    names = set(digests({"recordings": lab.manifest("data/r").recordings, "files": {}}))
    assert any((lab.folder / "other" / "objects" / name[:2] / name).exists() for name in names)


@pytest.mark.inline
def test_a_manifest_edited_by_hand_is_refused(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    path = Path("data/r/manifest.json")
    path.write_text(path.read_text().replace('"material": "cork"', '"material": "foam"'))
    for command in ("scale data/r -o data/s", "show data/r", "explain data/r", "label data/r trial-000 --label a=1"):
        failed = lab.call(command)
        assert failed.code == 4 and "edited by hand" in failed.err, command
    path.write_text("{")
    assert lab.call("scale data/r -o data/s").code == 4


def test_an_output_that_tacpipe_did_not_write_is_left_alone(lab: Lab) -> None:
    Path("thesis").mkdir()
    Path("thesis/chapter1.tex").write_text("precious")
    failed = lab.call("simulate toy -o thesis")
    assert failed.code == 2 and "chapter1.tex" in failed.err
    assert [path.name for path in Path("thesis").iterdir()] == ["chapter1.tex"]


def test_a_project_that_was_moved_and_lost_a_manifest_is_still_known(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data").rename("moved")
    Path("moved/s/manifest.json").unlink()
    lab.run("scale moved/r -o moved/s --factor 3")
    assert tacpipe.open("moved/s").to_numpy()["trial-001"].values[1].tolist() == [6]


def test_check_says_whether_something_would_change_and_changes_nothing(lab: Lab) -> None:
    assert lab.call("simulate toy -o data/r --check").code == 3
    assert not Path("data").exists()
    lab.run("simulate toy -o data/r")
    assert lab.call("simulate toy -o data/r --check").code == 0
    failed = lab.call("simulate toy -o data/r --trials 5 --check")
    assert failed.code == 3 and len(lab.manifest("data/r").recordings) == 4
    lab.run("scale data/r -o data/s")
    assert lab.call("scale data/r -o data/s --factor 3 --check").code == 3


def test_recompute_and_compare_names_what_differs(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    import toy_stages  # type: ignore[import-not-found]

    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    assert lab.call("scale data/r -o data/s --recompute-and-compare").code == 0
    honest = toy_stages.scale.function

    def changed(params: toy_stages.Scale, recording: "Recording") -> pa.Table:
        return honest(toy_stages.Scale(3), recording)

    monkeypatch.setitem(toy_stages.scale.__dict__, "function", changed)
    before = lab.manifest("data/s")
    failed = lab.call("scale data/r -o data/s --recompute-and-compare")
    assert failed.code == 1 and "trial-003.parquet" in failed.err
    assert lab.manifest("data/s") == before


@pytest.mark.parametrize(
    ("module", "function", "value", "difference"),
    [
        (provenance, "threads", 977, r"threads: \d+, now 977"),
        (
            provenance,
            "_processor",
            {"model": "Zen 9", "instructions": ["sve"]},
            r"instructions: .*, now sve; model: .*9",
        ),
        (provenance, "_environment", {"libraries": {"numpy": "0.1"}}, r"numpy: [\d.]+, now 0\.1;"),
    ],
    ids=["threads", "processor", "libraries"],
)
def test_a_difference_to_what_another_processor_number_of_threads_or_library_computed_names_them(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, module: ModuleType, function: str, value: Any, difference: str
) -> None:
    import toy_stages

    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    monkeypatch.setattr(module, function, lambda: value)
    same = lab.call("scale data/r -o data/s --jobs 1 --recompute-and-compare")
    assert same.code == 0 and "now" not in same.err
    honest = toy_stages.scale.function

    def changed(params: toy_stages.Scale, recording: "Recording") -> pa.Table:
        return honest(toy_stages.Scale(3), recording)

    monkeypatch.setitem(toy_stages.scale.__dict__, "function", changed)
    failed = lab.call("scale data/r -o data/s --jobs 1 --recompute-and-compare")
    assert failed.code == 1
    assert re.search(difference, failed.err), failed.err


@pytest.mark.parametrize("rows", range(3, 9))  # The keys come before and after one another.
def test_a_lost_shard_that_a_stage_gave_as_it_got_it_is_made_again_by_the_stage_that_made_it(
    lab: Lab, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACPIPE_LOCK_TIMEOUT_S", "0")  # Waiting for itself would last for ever.
    lab.run(f"simulate toy --trials 1 --rows {rows} -o data/r")
    lab.run("named data/r -o data/n")
    table = tacpipe.open("data/r").recordings["trial-000"].table("left")
    shard = lab.manifest("data/n").recordings["trial-000"]["shards"][""]["digest"]
    assert shard == lab.manifest("data/r").recordings["trial-000"]["shards"]["left"]["digest"]
    for path in (lab.store.object_path(shard), "data/n/trial-000.parquet", "data/r/trial-000/left.parquet"):
        Path(path).unlink()
    assert tacpipe.open("data/n").recordings["trial-000"].table().equals(table)


def test_shards_are_linked_and_recordings_copied(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    shard = lab.manifest("data/s").recordings["trial-000"]["shards"][""]["digest"]
    stream = lab.manifest("data/r").recordings["trial-000"]["shards"]["left"]["digest"]
    linked, stored = Path("data/s/trial-000.parquet").stat(), Path(lab.store.object_path(shard)).stat()
    assert linked.st_ino == stored.st_ino or linked.st_blocks == stored.st_blocks
    assert Path("data/r/trial-000/left.parquet").stat().st_ino != Path(lab.store.object_path(stream)).stat().st_ino


@pytest.mark.inline
def test_the_manifest_is_deterministic_and_its_digest_ignores_how_it_was_made(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/a --factor 2")
    first = Path("data/a/manifest.json").read_bytes()
    time.sleep(0.01)
    lab.run("scale data/r -o data/b --factor 2")
    assert Path("data/b/manifest.json").read_bytes() == first
    manifest = lab.manifest("data/a")
    by_hand = {
        "recordings": {
            name: {"attributes": entry["attributes"], "shards": {"": entry["shards"][""]["digest"]}}
            for name, entry in manifest.recordings.items()
        },
        "files": {},
    }
    assert json.loads(first)["digest"] == digest(by_hand)


def test_a_pool_of_processes_gives_the_same_as_one(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 20 --jobs 2")
    assert counts(lab.run("scale data/r -o data/a --jobs 2 --json").out) == (20, 0)
    pooled = Path("data/a/manifest.json").read_bytes()
    for path in lab.store.root.glob("records/*/*"):
        path.unlink()
    assert counts(lab.run("scale data/r -o data/b --jobs 1 --json").out) == (20, 0)
    assert Path("data/b/manifest.json").read_bytes() == pooled


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are counted as Linux lists them")
def test_recordings_computed_in_one_process_leave_no_file_open(lab: Lab) -> None:
    lab.run("simulate toy -o data/rec --trials 20 --jobs 1")
    before = len(list(Path("/proc/self/fd").iterdir()))
    lab.run("scale data/rec -o data/out --jobs 1")
    assert len(list(Path("/proc/self/fd").iterdir())) <= before
