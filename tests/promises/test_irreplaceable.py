"""A recording that cannot be made again stays marked as such after the loss of any one file of the store."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.datasets.manifest import Manifest, parse
from tacpipe.errors import DAMAGED
from tacpipe.io.hashing import bytes_digest
from tests.conftest import Lab, write_source
from tests.promises import damages, specimen
from tests.promises.counts import count
from tests.recording.test_recovering import spooled

COLLECT = "store gc --grace-days 0"
QUICK = ("it is gone", "a bit is flipped")
BROAD = (*QUICK, "it is empty", "its second half is lost")  # Damages of each kind: to bytes, to the size, to all of it.


@pytest.fixture(scope="module")
def manifests() -> list[Manifest]:
    """The manifests of all recordings of the project, labels included."""
    return []


@pytest.fixture
def project(lab: Lab, manifests: list[Manifest], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a project whose recordings are at their path, deleted, replaced, in no dataset, acquired and deleted."""
    manifests.clear()
    write_source("monday", a="1 2", b="3 4")
    lab.run("ingest numbers monday -o data/here")
    lab.run("label data/here a --set material=foam")
    manifests.append(lab.manifest("data/here"))
    lab.run("scale data/here -o data/scaled --factor 7")
    write_source("tuesday", c="5 6", d="7 8")
    lab.run("ingest numbers tuesday -o data/gone")
    lab.run("label data/gone c --exclude dropped")
    manifests.append(lab.manifest("data/gone"))
    shutil.rmtree("data/gone")
    write_source("wednesday", e="9 1")
    lab.run("ingest numbers wednesday -o data/over")
    lab.run("label data/over e --set material=cork")
    manifests.append(lab.manifest("data/over"))
    write_source("thursday", f="2 2")
    lab.run("ingest numbers thursday -o data/over --replace")
    manifests.append(lab.manifest("data/over"))
    write_source("friday", g="3 3", h="none")
    assert lab.call("ingest numbers friday -o data/bad").code == 1  # one of them is good, and is kept
    manifests.append(_read_alone(lab, "g"))
    spooled(lab)
    lab.run("acquire --recover")
    lab.run("label rec one --set material=cork")
    manifests.append(lab.manifest("rec"))
    shutil.rmtree("rec")
    original = tmp_path_factory.mktemp("made")
    specimen.clone(lab.folder, original)
    return original


def _read_alone(lab: Lab, name: str) -> Manifest:
    """Return the manifest of a recording that no dataset holds."""
    for path in specimen.beneath(lab.store.root / "objects"):
        if path.read_bytes().startswith(b"{\n"):
            parsed = parse(path.read_bytes(), path.name)
            if list(parsed.recordings) == [name]:
                return parsed
    raise AssertionError(name)


def files(store: Path) -> Iterator[Path]:
    return (path for path in sorted(specimen.beneath(store)) if path.stat().st_size)


def lost(lab: Lab, manifests: list[Manifest], spoiled: Path) -> list[str]:
    """Return what of the recordings and their labels is not in the store; what was spoiled itself is not looked for."""
    contents = {path.name: path.read_bytes() for path in specimen.beneath(lab.store.root / "objects")}
    objects = {name: content for name, content in contents.items() if bytes_digest(content) == name}
    stored_manifests = [
        parse(content, name) for name, content in objects.items() if content.startswith(b"{\n") and _is(content)
    ]
    missing = []
    for manifest in manifests:
        for path, name in manifest.objects():
            if name != spoiled.name and name not in objects:
                missing.append(path)
        is_stored = any(
            stored.labels == manifest.labels and stored.recordings == manifest.recordings for stored in stored_manifests
        )
        if not is_stored and spoiled.name != bytes_digest(manifest.content):
            missing.append(f"labels {manifest.labels}")
    return missing


def _is(content: bytes) -> bool:
    return b'"recordings"' in content and b'"digest"' in content


def fresh(original: Path, lab: Lab) -> None:
    for path in lab.folder.iterdir():
        shutil.rmtree(path)
    specimen.clone(original, lab.folder)


LOOKS = [
    *((damage, "store verify") for damage in QUICK),
    *(pytest.param(damage, "store verify", marks=pytest.mark.faults) for damage in damages.ALL if damage not in QUICK),
    *(
        pytest.param(damage, look, marks=pytest.mark.faults)
        for damage in BROAD
        for look in ("store repair", "store gc")
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("damage", "look"), LOOKS)
def test_no_recording_is_collected_whichever_one_file_of_the_store_is_damaged_or_gone(
    project: Path, lab: Lab, manifests: list[Manifest], damage: str, look: str
) -> None:
    tried = 0
    for spoiled in [path.relative_to(project) for path in files(project / ".tacpipe")]:
        fresh(project, lab)
        damages.ALL[damage](lab.folder / spoiled)
        for command in (look, COLLECT, COLLECT, COLLECT):
            specimen.age(lab.store.root)
            lab.call(command)
        assert lost(lab, manifests, spoiled) == [], spoiled
        tried += 1
    assert tried > 30
    count("corruptions found", tried)


@pytest.mark.long
def test_a_bit_flipped_anywhere_in_a_record_of_a_recording_costs_no_recording(
    project: Path, lab: Lab, manifests: list[Manifest]
) -> None:
    fresh(project, lab)
    keys = [key for key, record in lab.store.records() if record["provenance"].get("irreplaceable")]
    assert len(keys) == 8
    for number, key in enumerate(sorted(keys) * 3):
        fresh(project, lab)
        path = Path(lab.store.record_path(key))
        damages.flip(path, (number + 0.5) / (3 * len(keys)))
        for command in ("store verify", COLLECT, COLLECT, COLLECT):
            specimen.age(lab.store.root)
            lab.call(command)
        assert lost(lab, manifests, path) == []


@pytest.mark.inline
@pytest.mark.parametrize("folder", ["records", "roots", "objects"])
def test_records_roots_or_manifests_alone_keep_every_recording(
    project: Path, lab: Lab, manifests: list[Manifest], folder: str
) -> None:
    fresh(project, lab)
    shutil.rmtree(lab.folder / "data")
    if folder != "records":
        shutil.rmtree(lab.store.root / "records")
    if folder != "roots":
        shutil.rmtree(lab.store.root / "roots")
    if folder == "records":
        for path in specimen.beneath(lab.store.root / "objects"):
            if path.read_bytes().startswith(b"{\n"):
                path.unlink()
    for _ in range(3):
        specimen.age(lab.store.root)
        lab.run(COLLECT)
    missing = lost(lab, manifests, Path())
    assert [path for path in missing if folder != "records" or not path.startswith("labels")] == []
    specimen.age(lab.store.root)
    lab.run(f"{COLLECT} --recordings")  # asked for by name, all of it goes
    assert list(specimen.beneath(lab.store.root / "objects")) == [] or folder == "roots"


@pytest.mark.inline
@pytest.mark.parametrize(
    ("only", "removed", "before", "after"),
    [
        ("records", "objects", b'"irreplaceable"', b'"irreplaceablf"'),
        ("objects", "records", b'"recordings"', b'"recordingz"'),
    ],
)
def test_a_damaged_record_or_manifest_holds_from_quarantine_what_nothing_else_names(
    lab: Lab, only: str, removed: str, before: bytes, after: bytes
) -> None:
    write_source("src", a="1 2", b="3 4")
    lab.run("ingest numbers src -o data/rec")
    manifest = lab.manifest("data/rec")
    shards = [name for _, name in manifest.objects()]
    for folder in ("data", ".tacpipe/roots"):
        shutil.rmtree(folder)
    damaged = [path for path in specimen.beneath(lab.store.root / only) if before in path.read_bytes()]
    for path in specimen.beneath(lab.store.root / removed):
        if path.name not in shards:
            path.unlink()
    for path in damaged:
        damages.overwrite(path, path.read_bytes().replace(before, after))
    assert lab.call("store verify").code == DAMAGED
    assert len(list((lab.store.root / "quarantine").iterdir())) == len(damaged) > 0
    for _ in range(3):
        specimen.age(lab.store.root)
        lab.run(COLLECT)
        assert [name for name in shards if not lab.store.has(name)] == []
    for _ in range(2):  # asked for by name: the first removes what was damaged, the second what it named
        lab.run(f"{COLLECT} --recordings")
    assert [name for name in shards if lab.store.has(name)] == []


def test_a_manifest_whose_recordings_are_all_in_a_later_one_is_collected(lab: Lab) -> None:
    for number in range(4):
        write_source(f"day{number}", **{f"r{number}": f"{number} 1"})
        lab.run(f"ingest numbers day{number} -o data/rec")
        lab.run(f"label data/rec r{number} --set material=foam")
    lab.run("label data/rec r0 --set material=cork")  # said anew, by hand
    before = [path for path in specimen.beneath(lab.store.root / "objects") if path.read_bytes().startswith(b"{\n")]
    specimen.age(lab.store.root)
    lab.run("store gc")
    after = [path for path in specimen.beneath(lab.store.root / "objects") if path.read_bytes().startswith(b"{\n")]
    assert len(before) > 8 and after == [Path(lab.store.object_path(bytes_digest(lab.manifest("data/rec").content)))]
    shutil.rmtree(lab.store.root / "roots")
    shutil.rmtree("data")
    specimen.age(lab.store.root)
    lab.run("store gc")
    assert after[0].exists()


def test_quarantine_is_kept_for_the_grace_since_it_was_filled(lab: Lab) -> None:
    write_source("src", a="1 2")
    lab.run("ingest numbers src -o data/rec")
    lab.run("scale data/rec -o data/s")
    name = lab.manifest("data/s").recordings["a"]["shards"][""]["digest"]
    damages.flip(Path(lab.store.object_path(name)))
    specimen.age(lab.store.root)  # the shard was written long ago
    lab.call("store verify")
    lab.run("store gc")
    (quarantined,) = (lab.store.root / "quarantine").iterdir()
    lab.run("store gc --grace-days 0")
    assert not quarantined.exists()
    assert list((lab.store.root / "quarantine").iterdir()) == []
