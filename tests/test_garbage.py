import os
import shutil
import time
from pathlib import Path
from unittest.mock import ANY

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tacpipe
from tacpipe.io.hashing import bytes_digest
from tacpipe.maintenance import garbage, repair
from tacpipe.store.store import Store
from tests.conftest import Lab, write_source
from tests.test_pipeline import counts, replace_stream


def age(lab: Lab, days: float = 30.0) -> None:
    """Make everything in the store look old."""
    changed_s = time.time() - days * 86400
    for path in lab.store.root.rglob("*"):
        if path.is_file():
            os.utime(path, (changed_s, changed_s))


def collect_garbage(lab: Lab, options: str = "") -> dict[str, int]:
    value: dict[str, int] = lab.run_json(f"store gc {options}")
    return value


def replace_recording(lab: Lab) -> str:
    """Ingest a recording, then another in its place; return the digest of the first, which nothing names any more."""
    write_source("src", a="1 2 3")
    lab.run("ingest numbers src -o data/r")
    (name,) = (shard["digest"] for shard in lab.manifest("data/r").recordings["a"]["shards"].values())
    write_source("src", a="4 5 6")
    lab.run("ingest numbers src -o data/r --replace")
    return str(name)


def test_nothing_that_a_root_or_its_ancestors_need_is_removed(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("total data/s -o data/t")
    age(lab)
    assert collect_garbage(lab)["objects"] == 0
    assert counts(lab.run("total data/s -o data/t --json").out) == (0, 1)


@pytest.mark.inline
def test_what_an_output_held_before_is_removed_and_a_dry_run_only_counts(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    lab.run("scale data/r -o data/s --factor 3")
    age(lab)
    dry = collect_garbage(lab, "--dry-run")
    assert dry["objects"] == 4  # a manifest and three shards: three times two is two times three, and stays
    assert collect_garbage(lab) == {**dry, "drafts": dry["drafts"]}
    assert repair.verify(lab.store).clean
    assert counts(lab.run("scale data/r -o data/s --factor 3 --json").out) == (0, 4)
    ran, reused = counts(lab.run("scale data/r -o data/s --factor 2 --json").out)
    assert ran + reused == 4 and ran >= 3


def test_young_objects_and_those_of_a_running_process_are_kept(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    lab.run("scale data/r -o data/s --factor 3")
    assert collect_garbage(lab)["objects"] == 0  # seconds old: somebody may be about to name them
    manifest = lab.manifest("data/s")
    lab.run("scale data/r -o data/s --factor 5")
    age(lab)
    with lab.store.leases.running([bytes_digest(manifest.content)]):
        collect_garbage(lab)
    assert all(lab.store.has(name) for _, name in manifest.objects())


def test_what_a_run_announces_is_kept_however_old_it_looks(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    manifest = lab.manifest("data/s")
    lab.run("scale data/r -o data/s --factor 3")
    names = [name for _, name in manifest.objects()]
    store = lab.store
    with store.at_work():
        store.announce(names)
        age(lab)
        collect_garbage(lab)
        assert all(store.has(name) for name in names)
    collect_garbage(lab)
    assert sum(store.has(name) for name in names) == 1  # three times two is two times three


def test_what_is_announced_while_a_collection_is_at_it_is_put_back(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    before = {name for _, name in lab.manifest("data/s").objects()}
    lab.run("scale data/r -o data/s --factor 3")
    names = sorted(before - {name for _, name in lab.manifest("data/s").objects()})
    age(lab)
    looks = 0

    def looking(store: Store, *arguments: object, **options: object) -> garbage.LiveObjects:
        nonlocal looks
        looks += 1
        if looks == 2:  # everything was moved aside by now
            assert not any(Path(store.object_path(name)).exists() for name in names)
            working_store.announce(names)
        return live(store, *arguments, **options)  # type: ignore[arg-type]

    live = garbage.live
    monkeypatch.setattr(garbage, "live", looking)
    working_store = lab.store
    with working_store.at_work():
        garbage.collect(lab.store, dry_run=False)
    assert looks == 2
    assert all(Path(working_store.object_path(name)).exists() for name in names)
    assert list((working_store.root / "tmp").iterdir()) == []


def test_what_a_killed_collection_had_moved_aside_is_found_and_put_back(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    store = lab.store
    names = [name for _, name in lab.manifest("data/r").objects()]
    for name in names:
        Path(store.object_path(name)).rename(store.aside_path(name))
    assert store.read(names[0]) and store.has(names[1])
    age(lab)
    collect_garbage(lab)
    assert all(Path(store.object_path(name)).exists() for name in names)
    assert repair.verify(store).clean


def test_nothing_is_removed_while_a_manifest_that_something_descends_from_is_damaged(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("total data/s -o data/t")
    name = bytes_digest(Path("data/s/manifest.json").read_bytes())
    shutil.rmtree("data/s")
    lab.run("scale data/r -o data/u --factor 7")
    shutil.rmtree("data/u")
    age(lab)
    path = Path(lab.store.object_path(name))
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b"trial-00", b"trial-01"))
    before = sorted(lab.store.root.glob("objects/*/*"))
    failed = lab.call("store gc --grace-days 0")
    assert failed.code == 4 and name[:12] in failed.err and "nothing was removed" in failed.err
    assert sorted(lab.store.root.glob("objects/*/*")) == [remaining for remaining in before if remaining != path]
    lab.run("scale data/r -o data/s")
    assert collect_garbage(lab, "--grace-days 0")["objects"] > 0


def test_nothing_is_removed_while_a_root_is_damaged(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    root = lab.store.roots.get(lab.folder / "data/s")
    (file,) = (path for path in lab.store.root.glob("roots/*") if "data/s" in path.read_text())
    file.write_text(file.read_text().replace("data/s", "data/z"))
    age(lab)
    failed = lab.call("store gc")
    assert failed.code == 4 and "1 roots" in failed.err
    assert counts(lab.run("scale data/r -o data/s --json").out) == (0, 4)
    assert lab.store.roots.get(lab.folder / "data/s") == {**(root or {}), "written_s": ANY}
    assert collect_garbage(lab)["objects"] == 0


def test_a_recording_whose_record_was_damaged_is_kept_though_nothing_names_it(lab: Lab) -> None:
    name = replace_recording(lab)
    (record,) = (path for path in lab.store.root.glob("records/*/*") if name in path.read_text())
    record.write_text(record.read_text().replace("irreplaceable", "irreplaceablf"))
    for path in lab.store.root.glob("roots/*"):  # A root names the manifest that names the record.
        path.unlink()
    assert lab.call("store verify").code == 4 and not record.exists()
    for _ in range(3):
        age(lab)
        collect_garbage(lab, "--grace-days 0")
    assert lab.store.has(name)
    for _ in range(2):  # the first drops the damaged record, the second what it named
        collect_garbage(lab, "--grace-days 0 --recordings")
    assert not lab.store.has(name)


def test_what_was_pushed_to_a_store_stays_until_it_is_forgotten(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    remote = Store(lab.folder.with_name(f"{lab.folder.name}-remote"))
    lab.run(f"store push {remote.root} data/s")
    monkeypatch.setenv("TACPIPE_STORE", str(remote.root))
    for path in remote.root.rglob("*"):
        os.utime(path, (0, 0))
    assert collect_garbage(lab, "--grace-days 0")["objects"] == 0
    assert lab.call("store gc --forget data/other").code == 2
    assert collect_garbage(lab, "--grace-days 0 --forget data/s")["objects"] > 0


def test_a_project_that_was_moved_keeps_its_datasets(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    age(lab)
    moved = lab.folder.with_name(f"{lab.folder.name}-moved")
    lab.folder.rename(moved)
    monkeypatch.chdir(moved)
    assert collect_garbage(lab, "--grace-days 0")["objects"] == 0
    assert counts(lab.run("scale data/r -o data/s --json").out) == (0, 4)
    lab.folder.mkdir()


def test_recordings_that_nothing_names_are_kept_unless_asked_for(lab: Lab) -> None:
    name = replace_recording(lab)
    age(lab)
    assert collect_garbage(lab)["kept_recordings"] == 1 and lab.store.has(name)
    assert collect_garbage(lab, "--recordings")["objects"] >= 1 and not lab.store.has(name)


def test_a_root_that_cannot_be_reached_counts_for_fourteen_days(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data/s").rename("elsewhere")
    age(lab)
    assert collect_garbage(lab)["objects"] == 0
    root = lab.store.roots.get(lab.folder / "data/s")
    assert root is not None and "missing_since_s" in root
    root["missing_since_s"] -= 13 * 86400
    lab.store.roots.write(root)
    assert collect_garbage(lab)["objects"] == 0
    root["missing_since_s"] -= 2 * 86400
    lab.store.roots.write(root)
    assert collect_garbage(lab)["objects"] > 0


def test_the_fourteen_days_do_not_begin_with_a_clock_from_before_the_root_was_written(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data/s").rename("elsewhere")
    age(lab)
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: 86400.0)  # a computer without a battery starts in 1970
        collect_garbage(lab)
    assert collect_garbage(lab)["objects"] == 0


def test_the_fourteen_days_begin_anew_when_a_path_was_reached_in_between(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data/s").rename("elsewhere")
    age(lab)
    collect_garbage(lab)
    root = lab.store.roots.get(lab.folder / "data/s")
    assert root is not None
    lab.store.roots.write({**root, "missing_since_s": root["missing_since_s"] - 20 * 86400})
    Path("elsewhere").rename("data/s")
    collect_garbage(lab)
    assert "missing_since_s" not in (lab.store.roots.get(lab.folder / "data/s") or {})
    Path("data/s").rename("elsewhere")
    assert collect_garbage(lab)["objects"] == 0


def test_what_git_brought_back_to_a_path_is_live_though_the_root_names_another(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    old = Path("data/s/manifest.json").read_bytes()
    lab.run("scale data/r -o data/s --factor 3")
    Path("data/s/manifest.json").write_bytes(old)
    age(lab)
    collect_garbage(lab)
    assert tacpipe.open("data/s").to_numpy()["trial-001"].values[1].tolist() == [4]
    assert repair.verify(lab.store).clean


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.sampled_from(["scale 2", "scale 3", "total", "change", "gc", "drop"]), min_size=2, max_size=8))
def test_whatever_happens_in_whatever_order_no_dataset_at_a_path_loses_anything(lab: Lab, steps: list[str]) -> None:
    lab.run("simulate toy --trials 2 -o data/r")
    for step in steps:
        verb, _, value = step.partition(" ")
        if verb == "scale":
            lab.run(f"scale data/r -o data/s --factor {value}")
        elif verb == "total" and Path("data/s/manifest.json").exists():
            lab.run("total data/s -o data/t")
        elif verb == "change":
            replace_stream(lab, "data/r", "trial-000", "left", pa.table({"x": pa.array([len(steps)], pa.uint16())}))
        elif verb == "drop":
            Path("data/t/manifest.json").unlink(missing_ok=True)
        elif verb == "gc":
            age(lab)
            collect_garbage(lab, "--recordings --grace-days 0")
        for path in Path("data").glob("*/manifest.json"):
            for _, name in lab.manifest(str(path.parent)).objects():
                lab.store.read(name)


def test_leases_of_killed_processes_are_swept_up_and_those_of_others_stay(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    leases = lab.store.root / "leases"
    (leases / f"{'ab' * 32}.lock").touch()
    with lab.store.leases.hold("cd" * 32):
        collect_garbage(lab)
        assert [path.name[:2] for path in leases.iterdir()] == ["cd"]


def test_two_collections_do_not_run_at_once(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    with lab.store.leases.exclusive("gc"):
        failed = lab.call("store gc")
    assert failed.code == 6


def test_damage_to_a_record_that_keeps_its_size_and_times_is_found(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    assert repair.verify(lab.store).clean
    key = min(lab.store.names("records"))
    path = Path(lab.store.record_path(key))
    before, content = path.stat(), path.read_bytes()
    path.write_bytes(content.replace(b"scale", b"scalf").replace(b"toy", b"tov"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert repair.verify(lab.store).damaged == [key]
