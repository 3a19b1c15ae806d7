"""No command replaces recordings, labels or another stage's dataset unless it is asked to, and then they can be had back."""

import contextlib
import json
import shutil
from pathlib import Path

import pytest

import tacpipe
from tacpipe.io.hashing import bytes_digest
from tests.conftest import Lab, write_source
from tests.test_garbage import age
from tests.test_pipeline import counts


def folder_content(folder: str) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def check_refusal(lab: Lab, command: str, dataset: str, *words: str) -> None:
    """Check that a command is refused with exit code 2 and these words, and leaves a dataset as it was."""
    before = folder_content(dataset)
    for option in ("", " --check"):
        ran = lab.call(command + option)
        assert ran.code == 2 and ran.err.startswith("tacpipe: ") and ran.err.count("\n") == 1, ran
        assert all(word in ran.err for word in words), ran.err
        assert folder_content(dataset) == before


def list_manifests(lab: Lab) -> list[dict[str, object]]:
    manifests: list[dict[str, object]] = lab.run_json("store list")["manifests"]
    return manifests


# ---- inputs


@pytest.mark.parametrize("spelling", ["data/r", "data/../data/r", "./data/r/", "linked"])
def test_an_output_that_is_the_input_is_refused_with_and_without_replace(lab: Lab, spelling: str) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    Path("linked").symlink_to("data/r")
    check_refusal(lab, f"scale data/r -o {spelling}", "data/r", "is an input of this command")
    check_refusal(lab, f"scale data/r -o {spelling} --replace", "data/r", "is an input of this command")
    check_refusal(lab, f"scale data/r/manifest.json -o {spelling}", "data/r", "is an input of this command")


def test_split_codec_and_source_count_as_inputs_too(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 1")
    lab.run("halves data/s -o data/split")
    lab.run("centre data/s --split data/split -o data/c")
    check_refusal(lab, "centre data/s --split data/split -o data/split --replace", "data/split", "is an input")
    check_refusal(lab, "centre data/s --split data/split --codec data/c -o data/c --replace", "data/c", "is an input")
    write_source("src", a="1")
    check_refusal(lab, "ingest numbers src -o src --replace", "src", "is an input")


# ---- another stage's dataset


def test_a_dataset_of_another_stage_needs_replace_and_can_be_had_back_with_its_labels(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --set material=cork --exclude dropped")
    before = folder_content("data/r")
    check_refusal(
        lab, "simulate toy -o data/r", "data/r", "2 recordings written by ingest.numbers", "by hand on 1", "--replace"
    )
    lab.run("simulate toy -o data/r --replace")
    assert sorted(lab.manifest("data/r").recordings) == ["trial-000", "trial-001", "trial-002", "trial-003"]
    assert not Path("data/r/a").exists()
    (old,) = [entry for entry in list_manifests(lab) if entry["stage"] == "ingest.numbers" and entry["labelled"]]
    assert (old["recordings"], old["state"], old["path"]) == (2, "replaced", str(lab.folder / "data/r"))
    shutil.rmtree("src")
    lab.run(f"store checkout {str(old['manifest'])[:12]} -o data/back")
    assert {name.replace("data/back", "data/r"): value for name, value in folder_content("data/back").items()} == before


def test_a_derived_dataset_of_another_stage_needs_replace_too(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    check_refusal(lab, "named data/r -o data/s", "data/s", "4 recordings written by scale", "named would replace it")
    lab.run("named data/r -o data/s --replace")
    assert lab.manifest("data/s").stage == "named"


def test_a_stage_writes_its_own_dataset_again_with_other_params_and_inputs(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("simulate toy -o data/other --trials 2 --offset 5")
    lab.run("scale data/r -o data/s")
    lab.run("scale data/r -o data/s --factor 7")
    lab.run("scale data/other -o data/s")
    lab.run("simulate toy -o data/r --trials 2")
    assert sorted(lab.manifest("data/s").recordings) == sorted(lab.manifest("data/r").recordings) == [
        "trial-000",
        "trial-001",
    ]  # fmt: skip


def test_a_rerun_of_what_is_shown_is_never_refused(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --set material=cork")
    assert counts(lab.run("ingest numbers src -o data/r --json").out) == (0, 1)
    assert lab.call("ingest numbers src -o data/r --check").code == 0


def test_an_output_within_a_dataset_or_around_one_is_refused(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    check_refusal(lab, "scale data/r -o data/r/scaled", "data", "lies within the dataset")
    check_refusal(lab, "scale data/r -o data", "data", "holds the dataset")


def test_a_page_does_not_replace_a_file_that_tacpipe_did_not_write(lab: Lab, tmp_path: Path) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("notes.html").write_text("mine")
    ran = lab.call("page data/s -o notes.html")
    assert ran.code == 2 and "notes.html" in ran.err and Path("notes.html").read_text() == "mine"
    lab.run("page data/s -o notes.html --replace")
    assert Path("notes.html").read_text() == "<p>4 recordings</p>"
    lab.run("page data/s -o notes.html")
    Path("notes.html").write_text("changed by hand, and known to be ours")
    lab.run("page data/s -o notes.html")
    assert Path("notes.html").read_text() == "<p>4 recordings</p>"
    lab.run("page data/s -o new.html")


def test_an_emulated_rig_file_does_not_replace_another_one(lab: Lab) -> None:
    text = '[[stream]]\nname = "f"\nsensor = "pulse"\ntransport = "serial:/dev/ttyACM0"\n'
    Path("rig.toml").write_text(text)
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    ran = lab.call("sensors emulate rig.toml data/r -o . --duration-s 0.1")
    assert ran.code == 2 and "rig.toml already exists, and this command did not write it" in ran.err
    assert Path("rig.toml").read_text() == text


@pytest.mark.parametrize(("before", "refused"), [("grasp,force\n1,2\n", True), ("rank,score,off_deg,shift_m\n", False)])
def test_a_file_is_replaced_only_by_the_command_that_writes_such_files(
    tmp_path: Path, before: str, refused: bool
) -> None:
    from tacpipe.cli import candidates
    from tacpipe.datasets import replacing
    from tacpipe.errors import UsageError

    (tmp_path / "grasps.csv").write_text(before)
    with pytest.raises(UsageError) if refused else contextlib.nullcontext():
        replacing.refuse_foreign(tmp_path / "grasps.csv", candidates.HEADER.encode())


# ---- recordings that are ingested one after another


def test_ingest_appends(lab: Lab) -> None:
    write_source("monday", a="1 2", b="3 4")
    write_source("tuesday", c="5 6")
    lab.run("ingest numbers monday -o data/r")
    lab.run("label data/r b --set material=foam")
    ran, reused = counts(lab.run("ingest numbers tuesday -o data/r --json").out)
    appended = lab.manifest("data/r")
    assert (ran, reused) == (1, 0) and sorted(appended.recordings) == sorted(appended.sources) == ["a", "b", "c"]
    assert appended.recordings["b"]["attributes"]["material"] == "foam" and appended.labels == {
        "b": {"material": "foam"}
    }
    assert tacpipe.open("data/r").table("left")["x"].to_pylist() == [1, 2, 3, 4, 5, 6]
    assert counts(lab.run("ingest numbers monday -o data/r --json").out) == (0, 2)
    assert lab.manifest("data/r") == appended and lab.call("ingest numbers tuesday -o data/r --check").code == 0


def test_the_order_in_which_recordings_are_ingested_leaves_no_trace(lab: Lab) -> None:
    write_source("monday", a="1 2", b="3 4")
    write_source("tuesday", c="5 6")
    for first, second, output in (("monday", "tuesday", "data/one"), ("tuesday", "monday", "data/two")):
        lab.run(f"ingest numbers {first} -o {output}")
        lab.run(f"ingest numbers {second} -o {output}")
    assert Path("data/one/manifest.json").read_bytes() == Path("data/two/manifest.json").read_bytes()


def test_a_name_that_exists_with_other_content_is_refused(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    write_source("src", b="9")
    check_refusal(lab, "ingest numbers src -o data/r", "data/r", "of the same name", "other files: b.", "--replace")
    lab.run("ingest numbers src -o data/r --replace")
    assert tacpipe.open("data/r").table("left")["x"].to_pylist() == [1, 2, 9]


def test_replace_makes_the_dataset_that_of_the_source_alone(lab: Lab) -> None:
    write_source("monday", a="1 2", b="3 4")
    write_source("tuesday", c="5 6")
    lab.run("ingest numbers monday -o data/r")
    lab.run("ingest numbers tuesday -o data/r --replace")
    assert list(lab.manifest("data/r").recordings) == ["c"] and not Path("data/r/a").exists()


def test_a_recording_that_cannot_be_read_this_time_keeps_what_it_was(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    write_source("more", b="3", c="none")
    ran = lab.run("ingest numbers more -o data/r --skip-bad")
    kept_manifest = lab.manifest("data/r")
    assert (
        sorted(kept_manifest.recordings) == ["a", "b"]
        and list(kept_manifest.skipped) == ["c"]
        and "left out c" in ran.err
    )


# ---- labels


def test_labels_of_recordings_that_would_go_are_refused(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("label data/r trial-003 --set material=foam")
    check_refusal(lab, "simulate toy -o data/r --trials 3", "data/r", "labels that were set by hand", "trial-003")
    lab.run("simulate toy -o data/r --trials 3 --replace")
    (old,) = [entry for entry in list_manifests(lab) if entry["labelled"]]
    lab.run(f"store checkout {old['manifest']} -o data/back")
    assert lab.manifest("data/back").recordings["trial-003"]["attributes"]["material"] == "foam"


@pytest.mark.parametrize("removed", ["data/r", "data/r/manifest.json"])
def test_labels_come_back_with_their_recordings_when_the_directory_was_deleted(lab: Lab, removed: str) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --exclude dropped")
    before = Path("data/r/manifest.json").read_bytes()
    shutil.rmtree(removed) if Path(removed).is_dir() else Path(removed).unlink()
    assert counts(lab.run("ingest numbers src -o data/r --json").out) == (0, 2)
    assert Path("data/r/manifest.json").read_bytes() == before
    lab.run("scale data/r -o data/s")
    assert list(lab.manifest("data/s").recordings) == ["b"]


def test_labels_come_back_with_recordings_that_are_ingested_again_one_folder_after_the_other(lab: Lab) -> None:
    write_source("monday", a="1 2")
    write_source("tuesday", b="3 4", c="5 6")
    for folder in ("monday", "tuesday"):
        lab.run(f"ingest numbers {folder} -o data/r")
    lab.run("label data/r b --exclude dropped")
    lab.run("label data/r a --set material=cork")
    before = Path("data/r/manifest.json").read_bytes()
    shutil.rmtree("data/r")
    for folder in ("monday", "tuesday"):
        age(lab)
        lab.run("store gc --grace-days 0")
        lab.run(f"ingest numbers {folder} -o data/r")
        assert lab.call(f"ingest numbers {folder} -o data/r --check").code == 0
    assert Path("data/r/manifest.json").read_bytes() == before
    lab.run("scale data/r -o data/s")
    assert list(lab.manifest("data/s").recordings) == ["a", "c"]


def test_labels_come_back_when_another_stage_s_dataset_was_in_their_place(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --exclude dropped")
    before = Path("data/r/manifest.json").read_bytes()
    lab.run("simulate toy -o data/r --replace")
    lab.run("ingest numbers src -o data/r --replace")
    assert Path("data/r/manifest.json").read_bytes() == before


def test_the_labels_that_come_back_are_those_that_a_recording_had_last(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --exclude dropped --set material=cork")
    shutil.rmtree("data/r")
    write_source("src", a="7")
    lab.run("ingest numbers src -o data/r")  # another recording of this name
    write_source("src", a="1 2")
    for options in ("--replace", ""):
        lab.run(f"ingest numbers src -o data/r {options}")
        assert lab.manifest("data/r").labels == {"a": {"excluded": "dropped", "material": "cork"}}
    lab.run("label data/r a --include --set material=foam")
    shutil.rmtree("data/r")
    lab.run("ingest numbers src -o data/r")
    assert lab.manifest("data/r").recordings["a"]["attributes"] == {"material": "foam"}


@pytest.mark.parametrize("name", ["rec", "digest"])
def test_an_acquired_dataset_comes_back_with_its_labels_long_after_its_directory_was_deleted(
    lab: Lab, name: str
) -> None:
    from tests.recording.test_recovering import spooled

    spooled(lab)
    lab.run("acquire --recover")
    lab.run("label rec one --exclude dropped")
    before = folder_content("rec")
    dataset = name if name == "rec" else bytes_digest(before["rec/manifest.json"])[:12]
    shutil.rmtree("rec")
    for _ in range(3):
        age(lab, 300)
        lab.run("store gc --grace-days 0")
    (listed_entry,) = [entry for entry in list_manifests(lab) if entry["state"] == "directory gone"]
    assert (listed_entry["stage"], listed_entry["recordings"], listed_entry["labelled"]) == ("acquire", 1, 1)
    lab.run(f"store checkout {dataset} -o rec")
    assert folder_content("rec") == before


def test_labels_do_not_come_back_on_other_recordings_of_the_same_name(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --exclude dropped")
    lab.run("label data/r b --set material=cork")
    shutil.rmtree("data/r")
    write_source("src", a="7")
    lab.run("ingest numbers src -o data/r")
    assert lab.manifest("data/r").labels == {"b": {"material": "cork"}}


def test_acquired_recordings_of_one_name_and_rig_are_not_the_same(lab: Lab) -> None:
    from tests.recording.test_recovering import spooled

    spooled(lab, count=100)
    lab.run("acquire --recover")
    lab.run("label rec one --set material=cork")
    old = bytes_digest(Path("rec/manifest.json").read_bytes())
    shutil.rmtree("rec")
    spooled(lab, count=50)
    lab.run("acquire --recover")
    assert lab.manifest("rec").labels == {}
    root = lab.store.roots.get(lab.folder / "rec")
    assert root is not None and (root["history"][0]["manifest"], root["history"][0]["lasting"]) == (old, True)
    ran = lab.call(f"store checkout {old} -o rec")
    assert ran.code == 2 and "1 recordings that the new dataset does not have (one)" in ran.err
    lab.run(f"store checkout {old} -o back")
    assert tacpipe.open("back").table("force").num_rows == 100


# ---- what was replaced


def test_what_was_replaced_outlives_gc_but_not_one_that_is_asked_to_take_recordings(lab: Lab) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --set material=cork")
    lab.run("simulate toy -o data/r --replace")
    (old,) = [entry for entry in list_manifests(lab) if entry["labelled"]]
    age(lab)
    assert lab.run_json("store gc")["kept_recordings"] == 2
    lab.run(f"store checkout {old['manifest']} -o data/back")
    assert lab.manifest("data/back").labels == {"a": {"material": "cork"}}
    shutil.rmtree("data/back")
    lab.run("store gc --forget data/back")
    age(lab)
    lab.run("store gc --recordings --grace-days 0")
    assert not [entry for entry in list_manifests(lab) if entry["labelled"]]
    assert lab.call(f"store checkout {old['manifest']} -o data/back").code == 2


def test_a_directory_that_was_deleted_keeps_its_recordings_and_labels_in_the_store(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    lab.run("label data/r a --set material=cork")
    before = folder_content("data/r")
    shutil.rmtree("data/r")
    shutil.rmtree("src")
    for _ in range(2):
        age(lab, 300)
        lab.run("store gc --grace-days 0")
    (listed_entry,) = [entry for entry in list_manifests(lab) if entry["state"] == "directory gone"]
    for name in (listed_entry["dataset"], "data/r"):
        lab.run(f"store checkout {name} -o data/r")
        assert folder_content("data/r") == before
        shutil.rmtree("data/r")


@pytest.mark.inline
def test_a_derived_dataset_that_was_replaced_is_computed_again_when_it_is_checked_out(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    before = folder_content("data/s")
    lab.run("scale data/r -o data/s --factor 3")
    old = lab.store.roots.get(lab.folder / "data/s")
    assert old is not None
    first = old["history"][0]["manifest"]
    for name in {
        shard["digest"] for entry in lab.manifest("data/s").recordings.values() for shard in entry["shards"].values()
    }:
        assert lab.store.has(name)
    for path in lab.store.root.glob("objects/*/*"):
        if path.name in {shard for value in [json.loads(lab.store.read(first))] for shard in _shards(value)}:
            path.unlink()
    lab.run(f"store checkout {first} -o data/s --replace")
    assert folder_content("data/s") == before


def _shards(manifest: dict[str, dict[str, dict[str, dict[str, dict[str, str]]]]]) -> list[str]:
    return [shard["digest"] for entry in manifest["recordings"].values() for shard in entry["shards"].values()]


def test_a_manifest_that_no_root_names_any_more_is_checked_out_by_its_digest(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    before, name = folder_content("data/r"), bytes_digest(Path("data/r/manifest.json").read_bytes())
    shard = next(digest for _, digest in lab.manifest("data/r").objects())
    for path in lab.store.root.glob("roots/*"):
        path.unlink()
    shutil.rmtree("data")
    assert list_manifests(lab) == []
    lab.run(f"store checkout {name} -o data/r")
    assert folder_content("data/r") == before
    ran = lab.call(f"store checkout {shard} -o data/again")  # an object, but not a manifest
    assert ran.code == 2 and "knows no manifest" in ran.err


def test_a_checkout_replaces_recordings_only_when_it_is_asked_to(lab: Lab) -> None:
    write_source("one", a="1 2")
    write_source("two", b="3 4")
    lab.run("ingest numbers one -o data/one")
    lab.run("ingest numbers two -o data/two")
    root = lab.store.roots.get(lab.folder / "data/one")
    assert root is not None
    ran = lab.call(f"store checkout {root['manifest']} -o data/two")
    assert ran.code == 2 and "1 recordings that the new dataset does not have (b)" in ran.err
    lab.run(f"store checkout {root['manifest']} -o data/two --replace")
    assert list(lab.manifest("data/two").recordings) == ["a"]


def test_a_copy_without_its_store_is_kept_whole_when_it_is_replaced(
    lab: Lab, tmp_path_factory: pytest.TempPathFactory
) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    shutil.copytree("data/r", "data/copy")
    shutil.rmtree(lab.store.root)
    lab.store.root.mkdir()
    before = folder_content("data/copy")
    check_refusal(lab, "simulate toy -o data/copy", "data/copy", "1 recording written by ingest.numbers")
    lab.run("simulate toy -o data/copy --replace")
    (old,) = [entry for entry in list_manifests(lab) if entry["stage"] == "ingest.numbers"]
    lab.run(f"store checkout {old['manifest']} -o data/copy --replace")
    assert folder_content("data/copy") == before


def test_a_hundred_reruns_leave_a_short_history_and_one_loss_stays_in_it(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/r")
    root = lab.store.roots.get(lab.folder / "data/r")
    assert root is not None
    lab.run("simulate toy -o data/r --trials 1 --rows 3 --replace")
    for offset in range(1, 101):
        lab.store.roots.set(lab.folder / "data/r", f"{offset:064x}")
    last_root = lab.store.roots.get(lab.folder / "data/r")
    assert last_root is not None
    history = last_root["history"]
    assert len(history) == 21 and [entry["manifest"] for entry in history if entry["lasting"]] == [root["manifest"]]


@pytest.mark.parametrize(
    ("digest", "words"),
    [("3f2a", "6 or more hex digits"), ("0" * 12, "knows no manifest"), ("../etc/passwd", "nor a path at which")],
)
def test_a_digest_that_names_no_manifest_is_refused(lab: Lab, digest: str, words: str) -> None:
    lab.run("simulate toy -o data/r")
    ran = lab.call(f"store checkout {digest} -o data/x")
    assert ran.code == 2 and words in ran.err and not Path("data/x").exists()
