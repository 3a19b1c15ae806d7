"""Exports are keyed and incremental like any stage, and their files are the user's to write in."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tacpipe.exports.files import Files
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset

EVERY = (
    "csv rec",
    "mcap rec",
    "hdf5 rec",
    "card rec",
    "lerobot rec --rate-hz 100",
    "zarr rec --rate-hz 100",
    "hdf5 rec --structure robomimic --rate-hz 100",
)
LATER = [EVERY[0], *(pytest.param(export, marks=pytest.mark.long) for export in EVERY[1:])]


def counts(ran: str) -> tuple[int, int]:
    """Return how many ran and were reused."""
    content = json.loads(ran)
    return content["ran"], content["reused"]


@pytest.mark.parametrize("export", LATER)
def test_an_export_is_answered_by_the_store_the_second_time(rig: Lab, export: str) -> None:
    first = counts(rig.run(f"export {export} -o out --json").out)
    assert first[0] >= 2
    before = {path: path.stat().st_mtime_ns for path in (rig.folder / "out").rglob("*")}
    assert counts(rig.run(f"export {export} -o out --json").out) == (0, 2)
    assert {path: path.stat().st_mtime_ns for path in (rig.folder / "out").rglob("*")} == before
    assert rig.call(f"export {export} -o out --check").code == 0


@pytest.mark.parametrize(
    "export", ["csv", *(pytest.param(entry, marks=pytest.mark.long) for entry in ("mcap", "hdf5", "card"))]
)
def test_a_new_recording_costs_one_recording_and_leaves_the_files_of_the_others(rig: Lab, export: str) -> None:
    rig.run(f"export {export} rec -o out")
    old = {path: path.stat().st_mtime_ns for path in (rig.folder / "out").rglob("*") if "trial-0" in str(path)}
    write_dataset(rig.folder / "rec", recordings.trials(3))
    assert counts(rig.run(f"export {export} rec -o out --json").out) == (1, 2)
    assert {path: path.stat().st_mtime_ns for path in old if path.is_file()} == {
        path: at for path, at in old.items() if path.is_file()
    }
    assert any("trial-02" in str(path) for path in (rig.folder / "out").rglob("*"))


def test_a_removed_recording_s_files_go(rig: Lab) -> None:
    rig.run("export csv rec -o out")
    rig.run("label rec trial-01 --exclude broken")
    rig.run("export csv rec -o out")
    assert [path.name for path in sorted((rig.folder / "out").iterdir()) if path.is_dir()] == ["trial-00"]


def test_a_corrected_label_costs_no_file_of_values_where_these_do_not_hold_labels(rig: Lab) -> None:
    rig.run("export csv rec -o out")
    rig.run("label rec trial-01 --set object=mug")
    assert counts(rig.run("export csv rec -o out --json").out) == (0, 2)
    assert json.loads((rig.folder / "out/trial-01/labels.json").read_bytes())["object"] == "mug"


@pytest.mark.parametrize("export", ["mcap", pytest.param("hdf5", marks=pytest.mark.long)])
def test_a_corrected_label_costs_its_recording_where_files_hold_labels(rig: Lab, export: str) -> None:
    rig.run(f"export {export} rec -o out")
    rig.run("label rec trial-01 --set object=mug")
    assert counts(rig.run(f"export {export} rec -o out --json").out) == (1, 1)


def test_what_was_finished_before_a_failure_is_reused(rig: Lab) -> None:
    path = rig.folder / "rec/trial-01/arm.parquet"
    digest = rig.manifest("rec").recordings["trial-01"]["shards"]["arm"]["digest"]
    stored = Path(rig.store.object_path(digest))
    content = path.read_bytes()
    for copy in (path, stored):
        copy.chmod(0o644)
        copy.write_bytes(b"damaged")
    assert rig.call("export mcap rec -o out").code == 4
    assert not (rig.folder / "out").exists()
    path.write_bytes(content)
    assert counts(rig.run("export mcap rec -o out --json").out) == (1, 1)


@pytest.mark.long
def test_an_export_that_was_killed_resumes(lab: Lab) -> None:
    write_dataset(lab.folder / "rec", recordings.trials(24))
    before = len(list(lab.store.records()))
    command = [sys.executable, "-m", "tacpipe", "export", "mcap", "rec", "-o", "out", "--jobs", "1"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
        while len(list(lab.store.records())) == before and running.poll() is None:
            time.sleep(0.01)
        running.kill()
    ran, reused = counts(lab.run("export mcap rec -o out --json").out)
    assert reused >= 1
    assert ran + reused == 24
    assert len(list((lab.folder / "out").glob("*.mcap"))) == 24
    assert not [path for path in (lab.folder / "out").iterdir() if path.name.startswith(".")]


def test_a_directory_with_another_program_s_files_is_refused(rig: Lab) -> None:
    (rig.folder / "out").mkdir()
    (rig.folder / "out/notes.txt").write_text("mine")
    ran = rig.call("export csv rec -o out")
    assert ran.code == 2
    assert "notes.txt" in ran.err
    assert [path.name for path in (rig.folder / "out").iterdir()] == ["notes.txt"]


def test_another_stage_s_output_is_replaced_only_with_replace(rig: Lab) -> None:
    rig.run("export csv rec -o out")
    ran = rig.call("export mcap rec -o out")
    assert ran.code == 2
    assert "--replace" in ran.err
    rig.run("export card rec -o out --replace")
    rig.run("export mcap rec -o out --replace")
    names = sorted(path.name for path in (rig.folder / "out").rglob("*"))
    assert names == ["README.md", "manifest.json", "trial-00.mcap", "trial-01.mcap"]
    assert rig.call("export mcap rec -o rec").code == 2


EDITED = {  # command of an export, and a file of it that people edit
    "csv rec": ("README.md", "layout.toml", "trial-01/labels.json", "trial-00/skin.csv"),
    "mcap rec": ("README.md",),
    "hdf5 rec": ("README.md",),
    "card rec": ("README.md", "croissant.json"),
    "lerobot rec --rate-hz 100": ("meta/info.json",),
    "zarr rec --rate-hz 100": ("replay.zarr/meta/.zattrs",),
}


@pytest.mark.parametrize(("export", "name"), [(export, name) for export, names in EDITED.items() for name in names])
def test_an_edited_file_is_replaced_only_with_replace_and_comes_back_from_the_store(
    rig: Lab, export: str, name: str
) -> None:
    rig.run(f"export {export} -o out")
    path = rig.folder / "out" / name
    content = path.read_bytes()
    edited = content + b"by hand\n"
    path.write_bytes(edited)
    assert rig.run("store verify").code == 0  # the store has a copy of its own
    before = {file: file.read_bytes() for file in (rig.folder / "out").rglob("*") if file.is_file()}
    for options in ("", " --check"):
        ran = rig.call(f"export {export} -o out{options}")
        assert (ran.code, ran.err.count("\n")) == (2, 1 if not options else ran.err.count("\n"))
        assert name in ran.err
        assert "--replace" in ran.err
        assert {file: file.read_bytes() for file in (rig.folder / "out").rglob("*") if file.is_file()} == before
    rig.run(f"export {export} -o out --replace")
    assert path.read_bytes() == content
    assert rig.call(f"export {export} -o out --check").code == 0
    rig.run("store gc --grace-days 0")
    old = [entry for entry in json.loads(rig.run("store list --json").out)["manifests"] if entry["state"] == "replaced"]
    rig.run(f"store checkout {old[0]['manifest']} -o old")
    assert (rig.folder / "old" / name).read_bytes() == edited


def test_an_edited_file_of_a_recording_that_goes_is_not_deleted(rig: Lab) -> None:
    rig.run("export csv rec -o out")
    path = rig.folder / "out/trial-01/labels.json"
    path.write_text("{}")
    rig.run("label rec trial-01 --exclude broken")
    assert rig.call("export csv rec -o out").code == 2
    assert path.read_text() == "{}"


def test_a_file_that_somebody_put_where_an_export_will_write_is_not_replaced(rig: Lab) -> None:
    rig.run("label rec trial-01 --exclude later")
    rig.run("export csv rec -o out")
    path = rig.folder / "out/trial-01/labels.json"
    path.parent.mkdir()
    path.write_text("mine")
    rig.run("label rec trial-01 --include")
    assert rig.call("export csv rec -o out").code == 2
    assert path.read_text() == "mine"


def test_a_lost_file_is_brought_back_without_running(rig: Lab) -> None:
    rig.run("export csv rec -o out")
    (rig.folder / "out/trial-00/skin.csv").unlink()
    assert counts(rig.run("export csv rec -o out --json").out) == (0, 2)
    assert (rig.folder / "out/trial-00/skin.csv").exists()


def test_what_a_killed_run_left_in_folders_of_any_depth_is_swept(rig: Lab) -> None:
    rig.run("export card rec -o out")
    draft = rig.folder / "out/data/skin/.trial-00.parquet.0123456789ab.draft"
    draft.write_bytes(b"half")
    (draft.parent / "trial-00.parquet").unlink()
    rig.run("export card rec -o out")
    assert not draft.exists()


def test_the_manifest_leads_back_to_the_recordings(rig: Lab) -> None:
    rig.run("export mcap rec -o out")
    manifest = rig.manifest("out")
    assert manifest.inputs["datasets"][0]["dataset"] == rig.manifest("rec").digest
    assert str(rig.folder / "rec") in rig.run("explain out").out
    assert rig.manifest("rec").digest in (rig.folder / "out/README.md").read_text()


@pytest.mark.long
@pytest.mark.parametrize("export", EVERY)
def test_two_exports_of_the_same_recordings_are_the_same_bytes(rig: Lab, export: str) -> None:
    rig.run(f"export {export} -o one")
    ran = rig.call(f"export {export} -o one --recompute-and-compare")
    assert ran.code == 0, ran.err


def test_synchronized_recordings_are_exported_with_their_shards(rig: Lab) -> None:
    rig.run("synchronize rec -o sync --rate-hz 100")
    rig.run("export lerobot sync -o out")
    assert (rig.folder / "out/tacpipe/trial-00.parquet").read_bytes() == (
        rig.folder / "sync/trial-00.parquet"
    ).read_bytes()


def test_files_are_made_one_at_a_time() -> None:
    output: list[str] = []

    def make(name: str) -> bytes:
        output.append(name)
        return name.encode()

    files = Files({"a": b"x", "b": lambda: make("b"), "c": lambda: make("c")})
    assert (len(files), sorted(files), output) == (3, ["a", "b", "c"], [])
    assert files["b"] == b"b"
    assert output == ["b"]


def test_a_dataset_without_recordings_is_refused(rig: Lab) -> None:
    rig.run("label rec '*' --exclude all")
    assert rig.call("export csv rec -o out").code == 2
    assert not Path("out").exists()
