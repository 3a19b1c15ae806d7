"""Test stages with a store in a bucket and a local cache per computer."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from tacpipe.engine import computing
from tacpipe.engine.keys import Done, WorkerTask, identity
from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.maintenance import garbage, repair, transfer
from tacpipe.store import cached, location, records
from tacpipe.store.addresses import BucketAddress, parse_address
from tacpipe.store.bucket import Bucket
from tacpipe.store.cached import CachedStore
from tacpipe.store.remote import RemoteStore
from tests.conftest import Lab, Ran
from tests.promises.counts import count
from tests.stores import places
from tests.stores.places import KEY, SECRET, Place
from tests.stores.proxy import FAULTS, Proxy
from tests.stores.stepping import Stepping
from tests.stores.test_faults import at, since
from tests.test_pipeline import counts

SIMULATE = "simulate toy -o data/r --trials 3 --rows 3 --jobs 1"
SCALE = "scale data/r -o data/s --factor 2 --jobs 1"
CHAIN = (SIMULATE, SCALE, "centre data/s -o data/c --split data/split --jobs 1")
EVERY = pytest.mark.parametrize(
    "stride",
    [pytest.param(1, marks=pytest.mark.faults), pytest.param(5, marks=pytest.mark.long)],
)


@pytest.fixture(autouse=True)
def new_clients(impatient: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients of other tests are forgotten."""
    monkeypatch.setattr(cached, "_buckets", {})
    monkeypatch.setattr(cached, "_stores", set())


@dataclass
class Computers:
    """Several computers with projects of the same name that share one bucket."""

    lab: Lab
    monkeypatch: pytest.MonkeyPatch
    address: str
    names: list[str] = field(default_factory=list)

    def enter(self, name: str) -> Path:
        """Work on a computer from here on; return the folder of its project."""
        folder = self.lab.folder / name / "project"
        if name not in self.names:
            self.names.append(name)
            shutil.rmtree(self.lab.folder / ".tacpipe", ignore_errors=True)  # each has a project of its own
            folder.mkdir(parents=True)
            (folder / "dvc.yaml").touch()
        self.monkeypatch.chdir(folder)
        self.monkeypatch.setenv("TACPIPE_STORE", self.address)
        self.monkeypatch.setenv("TACPIPE_CACHE", str(folder.parent / "cache"))
        return folder

    def run(self, name: str, *commands: str) -> str:
        """Run commands on a computer that must succeed; return what the last one prints."""
        before = Path.cwd(), os.environ["TACPIPE_CACHE"]
        self.enter(name)
        printed = [self.lab.run(command).out for command in commands][-1]
        self.monkeypatch.chdir(before[0])
        self.monkeypatch.setenv("TACPIPE_CACHE", before[1])
        return printed

    @property
    def store(self) -> CachedStore:
        """The store of the computer at work."""
        cached_store = location.locate()
        assert isinstance(cached_store, CachedStore)
        return cached_store


def content(folder: Path) -> dict[str, bytes]:
    """Return all files of the datasets in a project."""
    below = folder / "data"
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(below.rglob("*")) if path.is_file()}


@pytest.fixture
def computers(lab: Lab, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Computers:
    """Computers that share a bucket in memory, the first of which is entered; each request is a step."""
    files = Stepping({})
    for module in (cached, transfer):
        monkeypatch.setattr(module, "Bucket", lambda address: request.node.files)
    request.node.files = files
    new_computers = Computers(lab, monkeypatch, "s3://lab/store")
    new_computers.enter("first")
    return new_computers


@pytest.fixture
def files(computers: Computers, request: pytest.FixtureRequest) -> Stepping:
    """The bucket of `computers`."""
    shared_bucket: Stepping = request.node.files
    return shared_bucket


@pytest.fixture
def emptied(computers: Computers, request: pytest.FixtureRequest) -> Callable[[dict[str, bytes]], Stepping]:
    """A function that puts another bucket in the place of that of `computers`, with this content, and clears all caches."""

    def empty(objects: dict[str, bytes]) -> Stepping:
        request.node.files = Stepping(objects)
        cached._buckets.clear()
        cached._stores.clear()
        for name in computers.names:
            shutil.rmtree(computers.lab.folder / name, ignore_errors=True)
        computers.names.clear()
        computers.enter("first")
        shared_bucket: Stepping = request.node.files
        return shared_bucket

    return empty


def expect_whole(files: Bucket) -> None:
    """Expect that a bucket is sound, and that every record names what is there."""
    store = RemoteStore(files)
    report = repair.verify(store)
    assert report.clean, report.to_text()
    named_digests = {
        shard["digest"]
        for _, record in store.records()
        for entry in record["result"]["recordings"].values()
        for shard in entry["shards"].values()
    }
    assert named_digests <= set(store.sizes(named_digests))


# ---- what a user sees


def test_a_chain_gives_the_same_bytes_with_any_store(lab: Lab, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = lab.folder / "plain"
    plain.mkdir()
    (plain / ".tacpipe").mkdir()
    monkeypatch.chdir(plain)
    lab.run(SIMULATE)
    lab.run(SCALE)
    computers = Computers(lab, monkeypatch, place.address)
    folder = computers.enter("first")
    lab.run(SIMULATE)
    lab.run(SCALE)
    assert content(folder) == content(plain)
    objects = {path.name for path in (plain / ".tacpipe/objects").glob("*/*")}
    records = {path.name for path in (plain / ".tacpipe/records").glob("*/*")}
    assert {Path(name).name for name in place.names("objects")} == objects
    assert {Path(name).name for name in place.names("records")} == records
    assert lab.run("store verify").out.endswith("all sound\n")


@pytest.mark.long
def test_another_computer_reuses_what_the_first_one_computed_whatever_server_keeps_it(
    lab: Lab, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    computers = Computers(lab, monkeypatch, place.address)
    first, second = computers.enter("first"), computers.enter("second")
    computers.run("first", SIMULATE, SCALE)
    assert counts(computers.run("second", f"{SIMULATE} --json")) == (0, 3)
    assert counts(computers.run("second", f"{SCALE} --json")) == (0, 3)
    assert content(first) == content(second)
    computers.run("second", "store gc --cache" if "://" in place.address else "store gc")
    assert counts(computers.run("second", f"{SCALE} --json")) == (0, 3)
    assert computers.run("first", "store verify").endswith("all sound\n")


def test_another_computer_brings_only_what_it_needs_and_computes_nothing(computers: Computers, files: Stepping) -> None:
    first = computers.enter("first")
    computers.run("first", SIMULATE, SCALE)
    second = computers.enter("second")
    assert counts(computers.lab.run(f"{SIMULATE} --json").out) == (0, 3)
    objects = {path.name for path in computers.store.root.glob("objects/*/*")}
    named_digests = {digest for _, digest in computers.lab.manifest("first/project/data/r").objects()}
    assert objects == named_digests | {manifest_digest(second / "data/r")}
    assert counts(computers.lab.run(f"{SCALE} --json").out) == (0, 3)
    assert content(first) == content(second)


def manifest_digest(directory: Path) -> str:
    """Return the digest of a dataset's manifest."""
    from tacpipe.io.hashing import bytes_digest

    return bytes_digest((directory / "manifest.json").read_bytes())


def test_where_there_is_nothing_to_do_nobody_is_asked(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE, SCALE)
    files.begin(0, lambda: None)
    assert counts(computers.lab.run(f"{SCALE} --json").out) == (0, 3)
    assert files.steps == 0


@pytest.mark.long
def test_a_hit_and_one_new_recording_take_as_many_requests_however_many_recordings_there_are(
    computers: Computers, files: Stepping
) -> None:
    request_counts: dict[int, tuple[int, int]] = {}
    for trial_count in (6, 18):
        simulate = f"simulate toy -o data/r{trial_count} --rows {trial_count} --jobs 1 --trials"
        scale = f"scale data/r{trial_count} -o data/s{trial_count} --factor 2 --jobs 1"
        computers.run("first", f"{simulate} {trial_count}", scale, f"{simulate} {trial_count + 1}")
        files.begin(0, lambda: None)
        assert counts(computers.lab.run(f"{scale} --json").out) == (1, trial_count)
        new = files.steps
        shutil.rmtree(f"data/s{trial_count}")
        files.begin(0, lambda: None)
        assert counts(computers.lab.run(f"{scale} --json").out) == (0, trial_count + 1)
        request_counts[trial_count] = new, files.steps
    assert request_counts[6] == request_counts[18], request_counts
    assert request_counts[18][0] < 40 and request_counts[18][1] < 5, request_counts


@pytest.mark.long
def test_a_hit_elsewhere_takes_one_request_an_object_and_few_more(computers: Computers, files: Stepping) -> None:
    computers.run("first", "simulate toy -o data/r --trials 20 --rows 3 --jobs 1")
    computers.enter("second")
    files.begin(0, lambda: None)
    assert counts(computers.lab.run("simulate toy -o data/r --trials 20 --rows 3 --json").out) == (0, 20)
    assert files.steps < 2 * 20 + 25  # there are two streams


@pytest.mark.inline
def test_status_list_and_checkout_show_what_the_bucket_holds(computers: Computers) -> None:
    computers.run("first", SIMULATE, SCALE)
    computers.enter("second")
    status = json.loads(computers.lab.run("store status --json").out)
    assert (status["store"], status["objects"]["files"], len(status["roots"])) == ("s3://lab/store", 11, 2)
    assert status["cache"]["objects"]["files"] == 0 and status["cache"]["path"].startswith(os.environ["TACPIPE_CACHE"])
    listed = json.loads(computers.lab.run("store list --json").out)["manifests"]
    assert {entry["path"] for entry in listed} == {"data/r", "data/s"}
    (digest,) = [entry["manifest"] for entry in listed if entry["path"] == "data/s"]
    computers.lab.run(f"store checkout {digest} -o data/back")
    stored = computers.lab.folder / "first/project/data/s/manifest.json"
    assert Path("data/back/manifest.json").read_bytes() == stored.read_bytes()
    assert "all sound" in computers.lab.run("store repair").out
    assert "s3://lab/store" in computers.lab.run("store status").out


@pytest.mark.inline
def test_copies_here_are_cleared_and_brought_again(computers: Computers, files: Stepping) -> None:
    folder = computers.enter("first")
    computers.run("first", SIMULATE, SCALE)
    before = content(folder)
    cleared = json.loads(computers.lab.run("store gc --cache --json").out)
    assert cleared["objects"] == 11 and not list(computers.store.root.glob("objects/*/*"))
    assert counts(computers.lab.run(f"{SCALE} --json").out) == (0, 3) and content(folder) == before
    expect_whole(files)


def test_what_the_bucket_lacks_stays_when_copies_are_cleared(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE)
    lost = next(iter(files.list("objects"))).name
    files.delete(lost)
    computers.lab.run("store gc --cache")
    assert [str(path.relative_to(computers.store.root)) for path in computers.store.root.glob("objects/*/*")] == [lost]


def test_copies_are_cleared_of_a_bucket_alone(lab: Lab) -> None:
    assert lab.call("store gc --cache").code == 2


def test_each_address_and_server_has_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def folder(address: str, endpoint: str = "") -> Path:
        monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
        parsed_address = parse_address(address)
        assert isinstance(parsed_address, BucketAddress)
        return cached.folder(parsed_address)

    monkeypatch.setenv("TACPIPE_CACHE", str(tmp_path / "copies"))
    folders = [
        folder("s3://lab/a"),
        folder("s3://lab/b"),
        folder("s3://lab/a", "http://rig:8333"),
        folder("gs://lab/a"),
    ]
    assert len(set(folders)) == 4 and all(path.parent == tmp_path / "copies" for path in folders)
    assert folder("s3://lab/a/") == folders[0]
    monkeypatch.delenv("TACPIPE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert folder("s3://lab/a") == tmp_path / "cache/tacpipe" / folders[0].name


# ---- damage, and what is gone


def test_a_damaged_copy_here_is_brought_again(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE)
    name = computers.lab.manifest("first/project/data/r").recordings["trial-001"]["shards"]["left"]["digest"]
    path = Path(computers.store.object_path(name))
    path.chmod(0o644)
    path.write_bytes(b"x" * path.stat().st_size)
    shutil.rmtree("data/r")
    assert counts(computers.lab.run(f"{SIMULATE} --json").out) == (0, 3)
    assert computers.store.read(name) == files.read(f"objects/{name[:2]}/{name}")


def test_a_damaged_object_of_the_bucket_is_recomputed_and_replaced(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE, SCALE)
    name = computers.lab.manifest("first/project/data/s").recordings["trial-001"]["shards"][""]["digest"]
    path = f"objects/{name[:2]}/{name}"
    sound = files.read(path)
    files.delete(path)
    files.create(path, sound[:-1] + b"x")
    second = computers.enter("second")
    computers.lab.run(SIMULATE)
    ran = computers.lab.call(SCALE)
    assert ran.code == 0, ran.err
    assert content(second) == content(computers.lab.folder / "first/project")
    assert files.read(path) == sound
    expect_whole(files)


@pytest.mark.parametrize("lost", ["bytes", "object"])
@pytest.mark.parametrize("survivor", ["copy", "dataset", "nothing"])
def test_a_repair_sends_again_what_is_damaged_or_missing_in_the_bucket(
    computers: Computers, files: Stepping, lost: str, survivor: str
) -> None:
    computers.run("first", SIMULATE, SCALE)
    recorded = computers.lab.manifest("first/project/data/r").recordings["trial-001"]["shards"]["left"]["digest"]
    computed = computers.lab.manifest("first/project/data/s").recordings["trial-001"]["shards"][""]["digest"]
    manifests = [manifest_digest(Path("data/r")), manifest_digest(Path("data/s"))]
    before = files.content()
    for name in (recorded, computed, *manifests):
        path = f"objects/{name[:2]}/{name}"
        files.delete(path)
        if lost == "bytes":
            files.create(path, before[path][:-1] + b"x")
    if survivor != "copy":
        shutil.rmtree(computers.store.root / "objects")
    if survivor == "nothing":
        for file in (Path("data/r/trial-001/left.parquet"), Path("data/s/trial-001.parquet")):
            file.unlink()
    ran = computers.lab.run("store repair --json")
    assert sorted(json.loads(ran.out)["repaired"]) == sorted([recorded, computed, *manifests])
    assert {name: value for name, value in files.content().items() if name.startswith("objects/")} == {
        name: value for name, value in before.items() if name.startswith("objects/")
    }
    assert len(list(files.list("quarantine"))) == (4 if lost == "bytes" else 0)
    expect_whole(files)


def test_a_repair_states_what_this_computer_cannot_have_again(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE, SCALE)
    name = computers.lab.manifest("first/project/data/r").recordings["trial-001"]["shards"]["left"]["digest"]
    for entry in [*files.list("records")]:
        files.delete(entry.name)
    computers.enter("second")
    files.delete(f"objects/{name[:2]}/{name}")
    ran = computers.lab.call("store repair")
    assert ran.code == 4 and name in ran.out and "cannot be recomputed" in ran.out


@pytest.mark.inline
def test_what_a_collection_took_is_computed_again(computers: Computers, files: Stepping) -> None:
    computers.run("first", SIMULATE, SCALE)
    shutil.rmtree("data/s")
    computers.lab.run("store gc --forget data/s")
    assert len(list(files.list("objects"))) == 7
    computers.run("second", SIMULATE)
    assert counts(computers.run("second", f"{SCALE} --json")) == (3, 0)
    expect_whole(files)


@pytest.mark.long
def test_what_was_forgotten_there_and_lies_here_goes_there_again_when_it_is_written(
    computers: Computers, files: Stepping
) -> None:
    computers.run("first", SIMULATE, SCALE, "store gc --forget data/s")
    assert len(list(files.list("objects"))) == 7
    shutil.rmtree("data/s")
    assert counts(computers.lab.run(f"{SCALE} --json").out) == (0, 3)
    assert len(list(files.list("objects"))) == 11
    expect_whole(files)


@pytest.mark.long
def test_a_dataset_whose_directory_is_gone_is_forgotten_after_the_grace_and_a_snapshot_is_not(
    computers: Computers, files: Stepping
) -> None:
    computers.run("first", SIMULATE, SCALE, "scale data/r -o data/t --factor 3 --jobs 1")
    computers.lab.run("store push s3://lab/store data/t")
    shutil.rmtree("data/s")
    shutil.rmtree("data/t")
    computers.lab.run("store gc")
    assert {root["path"] for root in RemoteStore(files).roots.all()} == {"data/r", "data/s", "data/t"}
    computers.lab.run("store gc --grace-days 0")
    assert {root["path"] for root in RemoteStore(files).roots.all()} == {"data/r", "data/t"}
    expect_whole(files)


@pytest.mark.long
def test_an_output_that_is_replaced_leaves_no_snapshot_unless_it_was_pushed(
    computers: Computers, files: Stepping
) -> None:
    def snapshots() -> list[str]:
        (root,) = [root for root in RemoteStore(files).roots.all() if root["path"] == "data/s"]
        return [root["manifest"], *(entry["manifest"] for entry in root["history"])]

    computers.run("first", SIMULATE, SCALE)
    first = manifest_digest(Path("data/s"))
    computers.lab.run("scale data/r -o data/s --factor 3 --jobs 1")
    second = manifest_digest(Path("data/s"))
    assert snapshots() == [second] != [first]
    computers.lab.run("store push s3://lab/store data/s")
    computers.lab.run("scale data/r -o data/s --factor 4 --jobs 1")
    assert snapshots() == [manifest_digest(Path("data/s")), second]


# ---- links that fail


@dataclass
class Linked:
    """A computer whose requests go through a proxy, and a new store for each try."""

    computers: Computers
    faulty: Proxy
    number: int = 0

    def next(self) -> Place:
        """Begin with a new store, and with nothing on the computer."""
        self.number += 1
        self.computers.address = f"s3://lab/{self.number}/store"
        self.computers.names.clear()
        self.computers.enter(f"computer-{self.number}")
        return places.bucket(self.computers.address)

    def under(self, fault: Callable[[int], str | None], command: str) -> Ran:
        """Run a command while requests fail."""
        self.faulty.begin(fault)
        ran = self.computers.lab.call(command)
        self.faulty.fault = lambda number: None
        return ran


@pytest.fixture
def linked(lab: Lab, faulty: Proxy, monkeypatch: pytest.MonkeyPatch) -> Linked:
    """A computer behind a proxy."""
    return Linked(Computers(lab, monkeypatch, ""), faulty)


@EVERY
@pytest.mark.parametrize("fault", FAULTS)
def test_a_stage_outlasts_a_fault_of_any_one_request(linked: Linked, fault: str, stride: int) -> None:
    reference = linked.next()
    linked.under(at(0, None), SIMULATE)
    requests, expected = linked.faulty.requests, reference.whole()
    assert requests > 20 and len(expected) == 7 + 4
    for step in range(1 + len(fault) % stride, requests + 1, stride):
        place = linked.next()
        ran = linked.under(at(step, fault), SIMULATE)
        assert ran.code == 0, (step, ran.err)
        assert digests(place.whole()) == digests(expected), step
        expect_whole(place.files)  # type: ignore[arg-type]
        count("requests to a store failed")


def digests(content_by_name: dict[str, bytes]) -> set[str]:
    """Return the names of objects and of records; records hold times too."""
    return set(content_by_name)


@EVERY
@pytest.mark.parametrize("fault", ["refused", "503", "cut upload", "cut answer"])
def test_a_stage_whose_link_fails_for_good_ends_in_a_sentence_and_its_rerun_gives_the_same_bytes(
    linked: Linked, fault: str, stride: int
) -> None:
    reference = linked.next()
    linked.under(at(0, None), SIMULATE)
    outputs = content(Path.cwd())
    requests, expected = linked.faulty.requests, reference.whole()
    failed = 0
    for step in range(1 + len(fault) % stride, requests + 1, stride):
        place = linked.next()
        ran = linked.under(since(step, fault), SIMULATE)
        assert ran.code in (0, 1) and "Traceback" not in ran.err and SECRET not in ran.err + ran.out, (step, ran)
        failed += ran.code
        if RemoteStore(place.files).check():
            expect_whole(place.files)  # type: ignore[arg-type]
        linked.computers.lab.run(SIMULATE)
        assert digests(place.whole()) == digests(expected) and content(Path.cwd()) == outputs, step
        expect_whole(place.files)  # type: ignore[arg-type]
        count("requests to a store failed")
    assert failed


def test_without_a_link_what_is_shown_is_a_hit_and_anything_else_a_sentence(linked: Linked) -> None:
    linked.next()
    computers, off = linked.computers, since(1, "refused")
    computers.lab.run(SIMULATE)
    computers.lab.run(SCALE)
    assert counts(linked.under(off, f"{SCALE} --json").out) == (0, 3)
    ran = linked.under(off, "scale data/r -o data/t --factor 9 --jobs 1")
    assert ran.code == 1 and computers.address in ran.err and ran.err.count("\n") == 1
    assert linked.under(off, "show data/s").code == 0


@pytest.mark.long
def test_a_label_is_kept_here_where_there_is_no_link_and_goes_there_with_the_next(linked: Linked) -> None:
    place = linked.next()
    run = linked.computers.lab.run
    run(SIMULATE)
    run("store push s3://lab/elsewhere data/r")  # a project has its identity from now on
    ran = linked.under(since(1, "refused"), "label data/r trial-000 --label material=foam")
    assert ran.code == 0 and linked.computers.address in ran.err
    assert "foam" in run("show data/r --json").out
    (root,) = RemoteStore(place.files).roots.all()
    assert root["manifest"] != manifest_digest(Path("data/r"))
    run("label data/r trial-001 --set material=cork")
    (root,) = RemoteStore(place.files).roots.all()
    assert root["manifest"] == manifest_digest(Path("data/r"))
    expect_whole(place.files)  # type: ignore[arg-type]


@pytest.mark.long
def test_credentials_are_in_nothing_that_is_kept_or_printed(linked: Linked) -> None:
    place = linked.next()
    printed = ""
    for command in (SIMULATE, SCALE, "store status", "store status --json", "explain data/s", "store list"):
        ran = linked.computers.lab.run(command)
        printed += ran.out + ran.err
    printed += linked.under(since(1, "503"), "scale data/r -o data/t --factor 9").err
    stored = [entry.name.encode() + place.files.read(entry.name) for entry in place.files.list("")]
    local = [path.read_bytes() for path in Path.cwd().parent.rglob("*") if path.is_file()]
    for secret in (SECRET, KEY):
        assert secret not in printed
        assert not [data for data in [*stored, *local] if secret.encode() in data]


def test_folders_that_begin_anew_are_one_project_where_the_environment_names_it(
    computers: Computers, files: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACPIPE_PROJECT", "nightly")
    for job in ("first", "second", "third"):
        computers.run(job, SIMULATE, SCALE)
    roots = RemoteStore(files).roots.all()
    assert sorted((root["project"]["name"], root["path"]) for root in roots) == [
        ("nightly", "data/r"),
        ("nightly", "data/s"),
    ]
    monkeypatch.setenv("TACPIPE_PROJECT", "other")
    computers.run("fourth", SIMULATE)
    monkeypatch.delenv("TACPIPE_PROJECT")
    computers.run("fifth", SIMULATE)
    assert len(RemoteStore(files).roots.all()) == 4


def test_a_job_that_begins_anew_pulls_what_an_earlier_one_pushed_under_the_name_of_the_environment(
    computers: Computers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACPIPE_PROJECT", "nightly")
    computers.run("first", SIMULATE, "store push s3://lab/elsewhere data/r")
    expected = content(computers.enter("first"))
    computers.run("second", "store pull s3://lab/elsewhere data/r")
    assert content(computers.enter("second")) == expected
    refused = computers.lab.call("store push s3://lab/elsewhere data/r --project another")
    assert refused.code == 2 and refused.err.count("\n") == 1


@pytest.mark.parametrize("name", ["a:b", "x" * 61, " lab", "a\tb"])
def test_a_name_that_no_project_can_have_is_refused(
    computers: Computers, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("TACPIPE_PROJECT", name)
    refused = computers.lab.call(SIMULATE)
    assert refused.code == 2 and "TACPIPE_PROJECT" in refused.err and refused.err.count("\n") == 1


def test_results_are_sent_while_others_are_computed_and_objects_still_come_before_their_records(
    computers: Computers, files: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    overlapping, create, lock = threading.Event(), files.create, threading.Lock()
    under_way = [0, 0]  # now, and at most

    def creating(name: str, content: bytes | Iterable[bytes]) -> bool:
        if not name.startswith("records/"):
            return create(name, content)
        assert isinstance(content, bytes)
        for digest in records.digests(json.loads(content)["result"]):
            assert files.stat(f"objects/{digest[:2]}/{digest}") is not None, name
        with lock:
            under_way[0] += 1
            under_way[1] = max(under_way)
            if under_way[0] > 1:
                overlapping.set()
        overlapping.wait(60)  # this times out if each waits for the one before
        created = create(name, content)
        with lock:
            under_way[0] -= 1
        return created

    monkeypatch.setattr(files, "create", creating)
    computers.run("first", SIMULATE.replace("--trials 3", "--trials 12"))
    assert overlapping.is_set() and 1 < under_way[1] <= computing.MAX_PENDING
    expect_whole(files)
    assert not [path for path in computers.store.root.glob("leases/*") if not path.name.startswith("run-")]
    computers.run("second", SIMULATE.replace("--trials 3", "--trials 12"))
    assert content(computers.lab.folder / "second/project") == content(computers.lab.folder / "first/project")


def test_what_another_computer_made_meanwhile_is_not_computed_where_many_are_looked_for_ahead(
    computers: Computers, files: Stepping
) -> None:
    command = SIMULATE.replace("--trials 3", "--trials 12")
    computers.run("first", command)
    tasks: dict[str, list[WorkerTask]] = {"scale": [], "simulate.toy": []}
    for _, record in computers.store.records():
        key = record["identity"]
        if "stage" in key and key["stage"] in tasks:
            tasks[key["stage"]].append(WorkerTask(computers.address, key["stage"], key))
    computers.enter("second")
    results = list(computing.compute.compute_all(tasks["simulate.toy"]))
    assert len(results) == 12 and not any(task.is_new for task in results)


def test_a_result_that_cannot_be_sent_ends_the_command_and_the_others_are_kept(
    computers: Computers, files: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    command, create, sent = SIMULATE.replace("--trials 3", "--trials 12"), files.create, itertools.count()

    def failing(name: str, content: bytes | Iterable[bytes]) -> bool:
        if name.startswith("records/") and next(sent) == 5:
            raise StorageError("s3://lab/store fails. It answers 503.")
        return create(name, content)

    with monkeypatch.context() as broken:
        broken.setattr(files, "create", failing)
        ran = computers.lab.call(command)
    assert ran.code == 1 and "503" in ran.err
    assert not list(computers.store.root.glob("leases/*"))
    assert counts(computers.lab.run(f"{command} --json").out) == (1, 11)
    expect_whole(files)


# ---- several at once


def steps(
    emptied: Callable[[dict[str, bytes]], Stepping], base: dict[str, bytes], stride: int, run: Callable[[], object]
) -> range:
    """Return the numbers of the requests that something takes on a bucket of this content."""
    files = emptied(base)
    files.begin(0, lambda: None)
    run()
    assert files.steps > 10
    return range(1, files.steps + 1, stride)


STEPS = pytest.mark.parametrize(
    "stride", [pytest.param(1, marks=pytest.mark.faults), pytest.param(4, marks=pytest.mark.long)]
)


@STEPS
@pytest.mark.parametrize("other_command", [SIMULATE, "simulate toy -o data/r --trials 2 --rows 3 --jobs 1"])
def test_the_same_or_another_run_elsewhere_at_any_request_does_no_harm(
    computers: Computers,
    emptied: Callable[[dict[str, bytes]], Stepping],
    one_at_a_time: None,
    stride: int,
    other_command: str,
) -> None:
    for step in steps(emptied, {}, stride, lambda: computers.run("first", SIMULATE)):
        files = emptied({})
        files.begin(step, lambda: computers.run("second", other_command))
        computers.run("first", SIMULATE)
        expect_whole(files)
        assert counts(computers.run("third", f"{SIMULATE} --json")) == (0, 3)
        folder = computers.lab.folder
        assert content(folder / "first/project") == content(folder / "third/project")
        count("runs beside runs, in a bucket")


@STEPS
def test_a_collection_at_any_request_of_a_run_takes_nothing_that_it_needs(
    computers: Computers, emptied: Callable[[dict[str, bytes]], Stepping], one_at_a_time: None, stride: int
) -> None:
    computers.run("first", SIMULATE)
    files = emptied({})
    computers.run("first", SIMULATE)
    for root in RemoteStore(files).roots.all():
        RemoteStore(files).roots.remove(root)
    abandoned = files.content()  # nothing names these objects any more, and a run would reuse them

    def collect() -> None:
        garbage.collect(RemoteStore(files), dry_run=False, recordings=True)

    for base in ({}, abandoned):
        for step in steps(emptied, base, stride, lambda: computers.run("first", SIMULATE)):
            files = emptied(base)
            files.begin(step, collect)
            computers.run("first", SIMULATE)
            expect_whole(files)
            assert counts(computers.run("second", f"{SIMULATE} --json")) == (0, 3), step
            count("collections beside runs, in a bucket")


@STEPS
def test_a_run_that_is_killed_at_any_request_leaves_a_sound_bucket_and_its_rerun_gives_the_same_bytes(
    computers: Computers, emptied: Callable[[dict[str, bytes]], Stepping], one_at_a_time: None, stride: int
) -> None:
    class Killed(BaseException):
        """Ends a run as no handler expects."""

    def killed() -> None:
        raise Killed

    files = emptied({})
    computers.run("first", SIMULATE)
    expected = {name for name in files.content() if name.startswith(("objects", "records"))}
    outputs = content(Path.cwd())
    for step in steps(emptied, {}, stride, lambda: computers.run("first", SIMULATE)):
        files = emptied({})
        files.begin(step, killed)
        with pytest.raises(Killed):
            computers.lab.call(SIMULATE)
        files.begin(0, lambda: None)
        if RemoteStore(files).check():
            expect_whole(files)
        computers.enter("first")
        computers.lab.run(SIMULATE)
        expect_whole(files)
        assert content(Path.cwd()) == outputs
        assert {name for name in files.content() if name.startswith(("objects", "records"))} == expected
        count("runs killed, in a bucket")


@pytest.mark.long
def test_processes_that_are_killed_while_they_upload_leave_a_bucket_in_which_a_rerun_gives_the_same_bytes(
    lab: Lab, localbucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = "simulate toy -o data/r --trials 40 --rows 3"
    plain = Computers(lab, monkeypatch, "s3://lab/plain/store")
    folder = plain.enter("plain")
    lab.run(command)
    expected, expected_names = content(folder), set(places.bucket(plain.address).whole())
    for number in range(6):
        killed = Computers(lab, monkeypatch, f"s3://lab/killed-{number}/store")
        folder = killed.enter(f"killed-{number}")
        place = places.bucket(killed.address)
        process = subprocess.Popen(
            [sys.executable, "-m", "tacpipe", *command.split(), "--jobs", "2"], start_new_session=True
        )
        while process.poll() is None and len(place.names("objects")) < 1 + 7 * number:
            time.sleep(0.002)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        expect_whole(place.files)  # type: ignore[arg-type]
        lab.run(f"{command} --jobs 1")
        assert content(folder) == expected and set(place.whole()) == expected_names
        expect_whole(place.files)  # type: ignore[arg-type]
        count("runs killed, in a bucket")


@pytest.mark.long
def test_two_computers_that_run_the_same_and_other_stages_at_once_end_with_the_same_bytes(
    lab: Lab, localbucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    computers = Computers(lab, monkeypatch, "s3://lab/shared/store")
    line = [sys.executable, "-m", "tacpipe"]
    for command in ("simulate toy -o data/r --trials 20 --rows 3", "scale data/r -o data/s --factor 2"):
        running = []
        for name in ("first", "second"):
            computers.enter(name)
            running.append(subprocess.Popen([*line, *command.split(), "--jobs", "2"]))
        computers.enter("third")
        running.append(subprocess.Popen([*line, *["simulate", "toy", "-o", "data/r", "--trials", "11", "--rows", "3"]]))
        running.append(subprocess.Popen([*line, "store", "gc"]))
        assert [process.wait() for process in running] == [0, 0, 0, 0]
    assert content(lab.folder / "first/project") == content(lab.folder / "second/project")
    expect_whole(places.bucket(computers.address).files)  # type: ignore[arg-type]
    computers.enter("fourth")
    assert counts(lab.run("simulate toy -o data/r --trials 20 --rows 3 --json").out) == (0, 20)


@pytest.mark.long
def test_a_worker_of_dask_reaches_the_bucket_by_its_address_and_keeps_copies_of_its_own(
    lab: Lab, localbucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    computers = Computers(lab, monkeypatch, "s3://lab/dask/store")
    folder = computers.enter("client")
    lab.run("simulate toy -o data/r --trials 6 --rows 3")
    assert counts(lab.run("scale data/r -o data/s --factor 2 --executor dask --jobs 2 --json").out) == (6, 0)
    computers.enter("other")
    lab.run("simulate toy -o data/r --trials 6 --rows 3")
    lab.run("scale data/r -o data/s --factor 2")
    assert content(folder) == content(Path.cwd())
    expect_whole(places.bucket(computers.address).files)  # type: ignore[arg-type]


def test_a_worker_with_a_folder_of_its_own_gives_its_results_by_way_of_the_bucket(
    computers: Computers, files: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = computing.compute

    def elsewhere(task: WorkerTask) -> Done:
        with monkeypatch.context() as patch:
            patch.setenv("TACPIPE_CACHE", str(computers.lab.folder / "worker"))
            return honest(replace(task, run=""))

    computers.run("first", SIMULATE)
    with monkeypatch.context() as patch:
        patch.setattr(computing, "compute", elsewhere)
        assert counts(computers.lab.run(f"{SCALE} --json").out) == (3, 0)
    assert json.loads(computers.lab.run(f"{SCALE} --json").out)["reused"] == 3
    expect_whole(files)
    computers.run("second", SIMULATE, SCALE)
    assert content(computers.lab.folder / "second/project") == content(Path.cwd())


def test_a_store_of_another_format_is_refused(computers: Computers, files: Stepping) -> None:
    files.create("format", b"99\n")
    ran = computers.lab.call(SIMULATE)
    assert ran.code == 2 and "99" in ran.err
    with pytest.raises(UsageError):
        computers.store.bucket  # noqa: B018


def test_a_record_that_others_replace_all_the_time_is_an_error(
    files: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "create", lambda name, content: False)
    with pytest.raises(TacpipeError, match="again"):
        RemoteStore(files).commit(identity("x", 1, {}, {}), {"recordings": {}, "files": {}}, {}, replace=True)
