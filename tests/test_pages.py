"""Datasets whose manifest lists pages: they hold what a manifest that holds the recordings itself does."""

import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import tacpipe
from tacpipe.datasets import manifest, pages
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import Item, Page, Pages
from tacpipe.engine import keys
from tacpipe.errors import DAMAGED, DamagedError, TacpipeError
from tacpipe.io import hashing
from tacpipe.store.records import Content, RecordingEntry, Shard
from tests.conftest import Lab
from tests.promises.test_hostile_manifest import HOSTILE

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="/\\\0"), min_size=1, max_size=4).filter(
    lambda name: name.isprintable() and name[0] != "."
)
VALUES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
SHARDS = st.builds(lambda rows: {"digest": f"{rows:064x}", "rows": rows, "bytes": 2 * rows}, st.integers(0, 2**40))
ENTRIES = st.fixed_dictionaries(
    {
        "attributes": st.dictionaries(st.text(max_size=3) | st.just("excluded"), VALUES, max_size=3),
        "shards": st.dictionaries(NAMES, SHARDS, max_size=2),
    }
)
LABELS = st.none() | st.dictionaries(st.text(max_size=3), VALUES, min_size=1, max_size=2)
ITEMS = st.builds(Item, ENTRIES, LABELS, st.none() | st.just({"raw": "0" * 64}))
MANY = st.dictionaries(NAMES, ITEMS, min_size=2, max_size=12)
FILES: dict[str, Content] = {"a": {"digest": "0" * 64, "bytes": 1}}


def of_items(items: dict[str, Item]) -> Manifest:
    """Return a manifest that was not divided into pages before."""
    return Manifest(
        "stage",
        1,
        files=FILES,
        recordings={name: item.entry for name, item in items.items()},
        labels={name: item.labels for name, item in items.items() if item.labels is not None},
        sources={name: item.sources for name, item in items.items() if item.sources is not None},
    )


class Objects:
    """Reads pages from memory."""

    def __init__(self, content: dict[str, bytes]) -> None:
        self.content, self.place, self.reads = content, "memory", 0

    def __call__(self, page: Page) -> bytes:
        self.reads += 1
        return self.content[page.digest]


def read_again(full_manifest: Manifest) -> tuple[Manifest, Objects]:
    """Return a manifest as another process reads it, and its pages."""
    assert full_manifest.pages is not None
    objects = Objects(dict(full_manifest.pages.fresh))
    manifest._parsed.clear()
    return manifest.parse(full_manifest.content, "manifest", objects), objects


@contextmanager
def divide_into_pages(grouped: int) -> Iterator[None]:
    """All datasets of two recordings and more have pages, with ``grouped`` recordings in the mean."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pages, "INLINE", 1)
        patched.setattr(pages, "GROUPED", grouped)
        yield


@pytest.mark.inline
def test_a_dataset_of_a_thousand_recordings_has_the_manifest_that_it_always_had() -> None:
    entry: RecordingEntry = {"attributes": {}, "shards": {"": {"digest": "0" * 64, "rows": 1, "bytes": 1}}}
    thousand, thousand_and_one = ({f"r{number:05d}": entry for number in range(count)} for count in (1000, 1001))

    value = json.loads(Manifest("stage", 1, recordings=thousand).content)
    assert value["format"] == 1
    assert value["recordings"] == thousand
    assert (
        Manifest("stage", 1, recordings=thousand).content
        == (json.dumps(value, sort_keys=True, indent=1) + "\n").encode()
    )
    root = json.loads(Manifest("stage", 1, recordings=thousand_and_one).content)
    assert root["format"] == 2
    assert "recordings" not in root
    assert sum(page["recordings"] for page in root["pages"]) == 1001


@given(MANY, st.integers(1, 5))
def test_a_manifest_that_lists_pages_holds_what_it_was_made_of(items: dict[str, Item], grouped: int) -> None:
    with divide_into_pages(grouped):
        full_manifest = of_items(items)
        parsed, _ = read_again(full_manifest)

        assert dict(parsed.recordings) == full_manifest.recordings
        assert list(parsed.recordings) == sorted(items)
        assert dict(parsed.labels) == full_manifest.labels
        assert dict(parsed.sources) == full_manifest.sources
        assert parsed.recordings.get("not there/") is None
        assert (parsed.digest, parsed.rows, parsed.shard_bytes) == (
            full_manifest.digest,
            full_manifest.rows,
            full_manifest.shard_bytes,
        )
        shards = [(path, name, size) for path, name, size in parsed.contents() if not path.startswith("page-")]
        assert sorted(shards) == sorted((p, n, s) for p, n, s in full_manifest.contents() if not p.startswith("page-"))
        assert dict(parsed.included) == {
            name: item.entry for name, item in items.items() if not item.entry["attributes"].get("excluded")
        }
        assert pickle.loads(pickle.dumps(parsed.recordings)) == full_manifest.recordings
        rebuilt = Manifest("stage", 1, files=FILES, recordings=dict(parsed.recordings), labels=parsed.labels)
        assert rebuilt.digest == parsed.digest  # how the recordings came together does not count


@given(MANY, st.data(), st.integers(1, 5))
def test_recordings_that_come_change_or_go_give_the_pages_of_a_dataset_made_at_once(
    items: dict[str, Item], data: st.DataObject, grouped: int
) -> None:
    with divide_into_pages(grouped):
        parsed, _ = read_again(of_items(items))
        changes = data.draw(st.dictionaries(st.sampled_from(sorted(items)) | NAMES, st.none() | ITEMS, max_size=5))
        expected = {name: item for name, item in {**items, **changes}.items() if item is not None}
        changed = parsed.with_recordings(changes)

        assert dict(changed.recordings) == {name: item.entry for name, item in expected.items()}
        assert changed.content == of_items(dict(sorted(expected.items()))).content


@given(MANY, st.integers(1, 5))
def test_a_key_over_a_dataset_in_pages_is_that_of_its_recordings(items: dict[str, Item], grouped: int) -> None:
    with divide_into_pages(grouped):
        parsed, _ = read_again(of_items(items))
        value = keys.of_dataset(parsed, None, parsed.included)
    plain = {name: keys.of_recording(item.entry, None) for name, item in sorted(items.items())}
    included = {name: entry for name, entry in plain.items() if not entry["attributes"].get("excluded")}
    assert hashing.digest(value) == hashing.digest({**value, "recordings": included})


def test_one_changed_recording_reads_and_writes_one_page(few_are_many: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "GROUPED", 16)
    shard: Shard = {"digest": "0" * 64, "rows": 1, "bytes": 1}
    full_manifest = of_items(
        {f"r{number:04d}": Item({"attributes": {}, "shards": {"": shard}}) for number in range(400)}
    )
    parsed, objects = read_again(full_manifest)
    changed = parsed.labelled({"r0123": {"material": "felt"}})
    assert changed.pages is not None
    assert len(changed.content) > 0
    assert objects.reads == 1
    assert len(changed.pages.fresh) == 1


ROOT_CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "a page of another order": lambda root: root["pages"].reverse(),
    "a page twice": lambda root: root["pages"].append(root["pages"][-1]),
    "no digest": lambda root: root["pages"][0].update(digest="../../x"),
    "a negative size": lambda root: root["pages"][0].update(bytes=-1),
    "no first name": lambda root: root["pages"][0].update(first=None),
    "no recording": lambda root: root["pages"][0].update(recordings=0),
    "unknown counts": lambda root: root["pages"][0].update(more=1),
    "no list": lambda root: root.update(pages={}),
    "recordings too": lambda root: root.update(recordings={}),
    "another content": lambda root: root["pages"][0].update(content="0" * 64),
    "a newer format": lambda root: root.update(format=3),
    "few recordings": lambda root: root.update(pages=[]),
}


@pytest.mark.parametrize("change", ROOT_CHANGES)
def test_a_root_that_none_can_be_is_refused_before_a_page_is_read(few_are_many: None, change: str) -> None:
    shard: Shard = {"digest": "0" * 64, "rows": 1, "bytes": 1}
    full_manifest = of_items({f"r{number}": Item({"attributes": {}, "shards": {"": shard}}) for number in range(9)})
    root = json.loads(full_manifest.content)
    ROOT_CHANGES[change](root)
    with pytest.raises(TacpipeError):
        manifest.parse(json.dumps(root).encode(), "given", Objects({}))


@pytest.mark.parametrize("case", HOSTILE)
def test_a_page_that_holds_what_no_manifest_can_is_refused_when_it_is_read(few_are_many: None, case: str) -> None:
    try:
        entries = json.loads(HOSTILE[case])["recordings"]
        stored = hashing.canonical({"labels": {}, "recordings": entries, "sources": {}})
        manifest.check(Manifest("stage", 1, recordings=entries))
    except (ValueError, TypeError, KeyError, AttributeError, TacpipeError, RecursionError):
        pass
    else:
        return  # The hostile part is not in its recordings.
    try:
        page = Page(next(iter(entries)), hashing.bytes_digest(stored), len(stored), "0" * 64, len(entries), 1, 1)
        loaded = Pages([page], Objects({page.digest: stored}), {})
    except (TypeError, AttributeError, UnboundLocalError, StopIteration):
        return
    with pytest.raises(DamagedError):
        loaded.load(0)


@pytest.mark.parametrize("field", ["first", "content", "recordings", "rows", "shard_bytes", "labelled", "excluded"])
def test_a_page_that_is_not_what_its_root_states_is_refused(few_are_many: None, field: str) -> None:
    shard: Shard = {"digest": "0" * 64, "rows": 1, "bytes": 1}
    full_manifest = of_items({f"r{number}": Item({"attributes": {}, "shards": {"": shard}}) for number in range(9)})
    assert full_manifest.pages is not None
    value: Any = full_manifest.pages.pages[0].to_json()
    value[field] = value.get(field, 0) + 1 if field not in ("first", "content") else "a" * 64
    changed_pages = Pages([Page.from_json(value)], Objects(dict(full_manifest.pages.fresh)), {})
    with pytest.raises(DamagedError):
        changed_pages.load(0)


def large(lab: Lab, count: int = 9) -> Pages:
    """Make data/r and data/s of it, whose manifests list pages, and return the pages of data/r."""
    lab.run(f"simulate toy --rows 3 --trials {count} -o data/r --jobs 1")
    lab.run("scale data/r -o data/s --jobs 1")
    dataset_pages = tacpipe.open(lab.folder / "data/r").source.pages
    assert dataset_pages is not None and len(dataset_pages) > 1
    return dataset_pages


@pytest.mark.usefixtures("few_are_many")
def test_a_damaged_page_costs_its_page_and_the_copy_in_the_directory_replaces_it(lab: Lab) -> None:
    page = large(lab).pages[0]
    path = Path(lab.store.object_path(page.digest))
    path.chmod(0o644)
    path.write_bytes(b"{}")
    manifest._parsed.clear()
    assert len(list(tacpipe.open(lab.folder / "data/r"))) == 9
    assert hashing.file_digest(path) == page.digest


@pytest.mark.usefixtures("few_are_many")
def test_a_missing_page_is_an_error_that_says_so_and_the_other_pages_are_read(lab: Lab) -> None:
    page, *_, last = large(lab).pages
    Path(lab.store.object_path(page.digest)).unlink()
    (lab.folder / "data/r" / page.path).unlink()
    manifest._parsed.clear()
    opened = tacpipe.open(lab.folder / "data/r")
    assert opened[last.first].table("left").num_rows == 3
    with pytest.raises(DamagedError, match="page of the manifest"):
        list(opened)
    for command in ("show data/r", "scale data/r -o data/t --factor 5 --jobs 1", "store gc"):
        ran = lab.call(command)
        assert (ran.code, page.digest[:12] in ran.err) == (DAMAGED, True), (command, ran.err)


@pytest.mark.usefixtures("few_are_many")
def test_a_missing_page_of_a_result_is_made_again_by_its_stage(lab: Lab) -> None:
    large(lab)
    source = tacpipe.open(lab.folder / "data/s").source
    before = source.content
    assert source.pages is not None
    for page in source.pages.pages:
        Path(lab.store.object_path(page.digest)).unlink()
        (lab.folder / "data/s" / page.path).unlink()
    manifest._parsed.clear()
    assert "0 ran, 9 reused" in lab.run("scale data/r -o data/s --jobs 1").err
    assert (lab.folder / "data/s/manifest.json").read_bytes() == before
    lab.run("store verify")
    assert len(list(tacpipe.open(lab.folder / "data/s"))) == 9


@pytest.mark.usefixtures("few_are_many")
def test_collections_keep_pages_of_labels_even_where_no_manifest_names_them(lab: Lab) -> None:
    large(lab)
    lab.run("label data/r trial-003 --set material=felt")
    manifest._parsed.clear()
    source = tacpipe.open(lab.folder / "data/r").source
    assert source.pages is not None
    labelled = next(page for page in source.pages.pages if page.labelled)
    for path in (lab.folder / ".tacpipe").rglob("*"):
        if path.is_file():
            os.utime(path, (1, 1))  # A file that was just written is left alone.
    shutil.rmtree(lab.folder / "data/r")
    for folder in ("roots", "records"):
        shutil.rmtree(lab.folder / ".tacpipe" / folder)
        (lab.folder / ".tacpipe" / folder).mkdir()
    Path(lab.store.object_path(source.content_digest)).unlink()
    lab.run("store gc --grace-days 0")
    assert lab.store.has(labelled.digest)
    shards = shards_of(pages.PageContent.from_bytes(lab.store.read(labelled.digest)))
    assert all(lab.store.has(name) for name in shards)
    unlabelled = [page.digest for page in source.pages.pages if not page.labelled]
    assert not any(lab.store.has(name) for name in unlabelled)


@pytest.mark.usefixtures("few_are_many")
def test_a_collection_notices_a_page_that_was_sound_before(lab: Lab) -> None:
    large(lab)
    lab.run("store gc --dry-run")
    source = tacpipe.open(lab.folder / "data/r").source.pages
    assert source is not None
    page = source.pages[0]
    for path in (Path(lab.store.object_path(page.digest)), lab.folder / "data/r" / page.path):
        path.chmod(0o644)
        path.write_bytes(b"{}")
    manifest._parsed.clear()
    assert lab.call("store gc --dry-run").code == DAMAGED


def shards_of(content: pages.PageContent) -> list[str]:
    return [shard["digest"] for entry in content.recordings.values() for shard in entry["shards"].values()]


@pytest.mark.usefixtures("few_are_many")
def test_a_dataset_in_pages_is_pushed_pulled_and_checked_out(
    lab: Lab, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    large(lab)
    lab.run("label data/r trial-003 --set material=felt")
    remote = tmp_path_factory.mktemp("remote") / "store"
    lab.run(f"store push {remote} data/r data/s")
    content = {name: (lab.folder / name / "manifest.json").read_bytes() for name in ("data/r", "data/s")}
    clone = tmp_path_factory.mktemp("other")
    (clone / ".tacpipe").mkdir()
    monkeypatch.chdir(clone)
    manifest._parsed.clear()
    (clone / "data/r").mkdir(parents=True)
    (clone / "data/r/manifest.json").write_bytes(content["data/r"])  # Git or DVC brings the manifest.
    ran = lab.call("scale data/r -o data/s --jobs 1")
    assert ran.code == DAMAGED and "store pull" in ran.err
    lab.run(f"store pull {remote} data/r")
    manifest._parsed.clear()
    opened = tacpipe.open(clone / "data/r")
    assert opened["trial-003"].attributes["material"] == "felt"
    assert all(recording.table("left").num_rows == 3 for recording in opened)
    shutil.rmtree(clone / "data/r")
    manifest._parsed.clear()
    lab.run(f"store checkout {hashing.bytes_digest(content['data/s'])} --remote {remote} -o data/s")
    assert (clone / "data/s/manifest.json").read_bytes() == content["data/s"]
    lab.run("store verify")


@pytest.mark.usefixtures("few_are_many")
def test_a_dataset_of_an_older_manifest_is_read_extended_and_then_lists_pages(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "INLINE", 1000)
    lab.run("simulate toy --rows 3 --trials 9 -o data/r --jobs 1")
    lab.run("scale data/r -o data/s --jobs 1")
    monkeypatch.setattr(pages, "INLINE", 1)
    manifest._parsed.clear()
    assert "0 ran, 9 reused" in lab.run("scale data/r -o data/s --jobs 1").err
    assert json.loads((lab.folder / "data/s/manifest.json").read_bytes())["format"] == 1
    lab.run("label data/r trial-003 --set material=felt")
    assert json.loads((lab.folder / "data/r/manifest.json").read_bytes())["format"] == 2
    lab.run("explain data/s")
    lab.run("simulate toy --rows 3 --trials 10 -o data/r --jobs 1")
    ran = lab.run("scale data/r -o data/s --jobs 1")
    assert json.loads((lab.folder / "data/s/manifest.json").read_bytes())["format"] == 2
    assert "9 reused" in ran.err
    assert tacpipe.open(lab.folder / "data/r")["trial-003"].attributes["material"] == "felt"
    lab.run("store verify")
    lab.run("store gc --dry-run")
