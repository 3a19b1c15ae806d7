"""Recordings of a manifest that are kept as its text: what they give is what all of it parsed at once gives."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import tacpipe
from tacpipe.datasets import manifest, page_text, pages
from tacpipe.datasets.dataset_digest import DatasetDigest
from tacpipe.datasets.described import Described
from tacpipe.datasets.manifest import Manifest
from tacpipe.engine import keys
from tacpipe.errors import DamagedError, TacpipeError
from tacpipe.io import hashing
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
MANY = st.dictionaries(NAMES, ENTRIES, min_size=1, max_size=12)
COLON = {
    ": ": {"attributes": {": ": ": "}, "shards": {}},
    "a": {"attributes": {"b ": ": c"}, "shards": {}},
}  # as after a name


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """All recordings are kept as text, two a page in the mean."""
    monkeypatch.setattr(pages, "LARGE", 0)
    monkeypatch.setattr(pages, "MANY", 1)
    monkeypatch.setattr(pages, "GROUPED", 2)
    monkeypatch.setattr(manifest, "_parsed", {})


def paged(whole: Manifest, grouped: int) -> Manifest:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pages, "LARGE", 1 << 20)
        patched.setattr(pages, "GROUPED", grouped)
        value = pages.split(whole.content, "given")
    assert value is not None
    assert isinstance(value["recordings"], pages.Pages)
    del value["format"], value["digest"]
    return Manifest(**value)


@given(MANY, st.integers(1, 5))
def test_a_manifest_in_pages_holds_what_it_holds_parsed_at_once(recordings: dict[str, Any], grouped: int) -> None:
    whole = Manifest("stage", 1, recordings=recordings, files={"a": {"digest": "0" * 64, "bytes": 1}})
    found = paged(whole, grouped)

    assert (
        list(found.recordings.items())
        == sorted(recordings.items())
        == list(zip(found.recordings, found.recordings.values(), strict=True))
    )
    assert len(found.recordings) == len(recordings)
    assert all(found.recordings[name] == entry for name, entry in recordings.items())
    assert found.recordings.get("not there/") is None
    assert (found.digest, found.content, found.rows) == (whole.digest, whole.content, whole.rows)
    assert sorted(found.contents()) == sorted(whole.contents())
    assert found.included == whole.included
    assert pickle.loads(pickle.dumps(found.recordings)) == recordings


@given(MANY, ENTRIES, st.integers(1, 5), st.data())
def test_what_is_changed_in_pages_is_what_is_changed_in_a_mapping(
    recordings: dict[str, Any], entry: Any, grouped: int, data: st.DataObject
) -> None:
    whole = Manifest("stage", 1, recordings=recordings)
    some = data.draw(st.dictionaries(st.sampled_from(sorted(recordings)), st.none() | st.just(entry)))
    found = pages.changed(paged(whole, grouped).recordings, some)

    expected = {**recordings, **some}
    expected = {name: one for name, one in expected.items() if one is not None}
    assert dict(found) == pages.changed(recordings, some) == expected
    assert len(found) == len(expected)
    assert Manifest("stage", 1, recordings=found).content == Manifest("stage", 1, recordings=expected).content


@pytest.mark.usefixtures("few_are_many")
@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_manifest_is_refused_in_pages_as_it_is_parsed_at_once(case: str) -> None:
    with pytest.raises(TacpipeError):
        manifest.parse(HOSTILE[case], "given")


SHARD = {"digest": "0" * 64, "rows": 1, "bytes": 1}
ENTRY = {"attributes": {}, "shards": {"": SHARD}}


def reordered(text: str) -> str:
    lines = text.split("\n")
    first, second = (next(place for place, line in enumerate(lines) if line.startswith(f'  "{name}"')) for name in "ab")
    lines[first], lines[second] = lines[second], lines[first]
    return "\n".join(lines)


@pytest.mark.usefixtures("few_are_many")
@pytest.mark.parametrize(
    "other",
    [
        lambda text: json.dumps(json.loads(text)),
        lambda text: json.dumps(json.loads(text), indent=2),
        lambda text: text.replace('"a"', '"\\u0061"'),
        lambda text: text.replace("\n", "\n\n"),
        reordered,
        lambda text: text.replace('\n  "b": {', '\n  "a": {'),  # two of one name
        lambda text: text.replace('\n  "b": {', '\n  "b": {}, "c": {'),
    ],
)
def test_a_manifest_that_another_program_wrote_is_what_json_makes_of_it(other: Any) -> None:
    text = Manifest("stage", 1, recordings=dict.fromkeys("abcd", ENTRY)).content.decode()
    assert isinstance(manifest.parse(text.encode(), "ours").recordings, pages.Pages)
    given = other(text)
    recordings = json.loads(given)["recordings"]
    try:
        found = manifest.parse(given.encode(), "given").recordings
    except DamagedError:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(pages, "LARGE", 1 << 30)
            with pytest.raises(DamagedError):
                manifest.parse(given.encode(), "given")
    else:
        assert found == recordings


def test_two_recordings_on_two_pages_that_name_one_path_are_refused(few_are_many: None) -> None:
    between = {f"a-{number:03d}": ENTRY for number in range(20)}
    recordings = {"a": {"attributes": {}, "shards": {"b": SHARD}}, **between, "a/b": ENTRY}
    with pytest.raises(DamagedError):
        manifest.parse(Manifest("stage", 1, recordings=recordings).content, "given")


def test_a_large_manifest_takes_little_more_memory_than_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "LARGE", 1 << 18)
    monkeypatch.setattr(pages, "GROUPED", 20)
    attributes = {"material": "felt", "sensor": "xela-uskin", "speed_m_s": 0.25}
    entries = {f"trial-{number:06d}": {"attributes": attributes, "shards": {"": SHARD}} for number in range(2_000)}
    content = Manifest("stage", 1, recordings=entries).content
    assert len(content) > pages.LARGE
    entries.clear()
    tracemalloc.start()
    try:
        found = manifest.parse(content, "given")
        assert sum(size for _, size in found.sizes()) == 2_000
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < len(content)


@pytest.mark.usefixtures("few_are_many")
def test_stages_give_the_same_datasets_where_recordings_are_kept_as_text(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chain(place: str) -> list[str]:
        lab.run(f"simulate toy --rows 2 --trials 12 -o {place}/toy --jobs 1")
        lab.run(f"scale {place}/toy -o {place}/scaled --jobs 1")
        lab.run(f"label {place}/toy trial-003 --set material=felt")
        lab.run(f"label {place}/toy trial-007 --exclude dropped")
        lab.run(f"simulate toy --rows 2 --trials 13 -o {place}/toy --jobs 1")
        ran = lab.run(f"scale {place}/toy -o {place}/scaled --jobs 1 --json")
        assert '"ran": 1,' in ran.out or place == "second"
        assert "0 ran" in lab.run(f"scale {place}/toy -o {place}/scaled --jobs 1").err
        assert not (lab.folder / place / "scaled/trial-007.parquet").exists()
        opened = tacpipe.open(lab.folder / place / "scaled")
        assert opened["trial-003"].attributes["material"] == "felt"
        assert len(opened) == 12
        return [opened.digest, tacpipe.open(lab.folder / place / "toy").digest]

    text = chain("first")
    assert isinstance(tacpipe.open(lab.folder / "first/scaled").source.recordings, pages.Pages)
    monkeypatch.undo()
    monkeypatch.chdir(lab.folder)
    assert chain("second") == text


@pytest.mark.usefixtures("few_are_many")
def test_a_dataset_in_pages_opens_its_recordings_when_they_are_asked_for(lab: Lab) -> None:
    lab.run("simulate toy --rows 2 --trials 9 -o data/toy")
    lab.run("label data/toy trial-002 --exclude dropped")
    opened = tacpipe.open(lab.folder / "data/toy")
    names = [f"trial-{number:03d}" for number in range(9) if number != 2]

    assert list(opened.recordings) == [one.name for one in opened] == names
    assert (len(opened), "trial-002" in opened, "trial-003" in opened) == (8, False, True)
    with pytest.raises(tacpipe.UsageError):
        opened["trial-002"]
    some = opened.only(["trial-007", "trial-001"])
    assert [one.name for one in some] == ["trial-001", "trial-007"]
    assert some["trial-001"].table("left").equals(opened.recordings["trial-001"].table("left"))
    copied = pickle.loads(pickle.dumps(some))
    assert copied.to_pandas("left").equals(some.to_pandas("left"))
    assert [one.name for one in opened.select(trial=lambda trial: trial > 6)] == ["trial-007", "trial-008"]


@given(MANY, st.integers(1, 5))
def test_the_size_of_a_shard_is_found_by_its_path(recordings: dict[str, Any], grouped: int) -> None:
    whole = Manifest("stage", 1, recordings=recordings, files={"a/b": {"digest": "0" * 64, "bytes": 7}})
    found = paged(whole, grouped)
    for path, name, size in whole.contents():
        assert found.size_of(name, path) == whole.size_of(name, path) == size
        assert found.size_of("1" * 64, path) is None
    assert whole.size_of("0" * 64, "not/there") is None


@given(MANY, st.integers(1, 5))
@example(COLON, 1)
def test_what_a_digest_is_made_of_is_the_same_of_text_as_of_what_was_parsed(
    recordings: dict[str, Any], grouped: int
) -> None:
    whole = Manifest("stage", 1, recordings=recordings)
    found = paged(whole, grouped).recordings
    assert isinstance(found, pages.Pages)
    by_text, by_value = DatasetDigest({}), DatasetDigest({})
    for number, text in enumerate(found.texts):
        described = page_text.described(text)
        part = found.part(number)
        if described is None:
            assert b'\\": ' in bytes(text) or b' ": ' in bytes(text)
            by_text.add(part)
        else:
            by_text.add_described(described)
        by_value.add(part)
    assert by_text.digest() == by_value.digest() == whole.digest


@given(MANY, st.dictionaries(NAMES, st.none() | ENTRIES, max_size=4), st.integers(1, 5))
def test_what_differs_between_two_datasets_in_pages_is_what_differs_between_two_mappings(
    recordings: dict[str, Any], other: dict[str, Any], grouped: int
) -> None:
    after = {name: one for name, one in {**recordings, **other}.items() if one is not None}
    before, now = (
        paged(Manifest("stage", 1, recordings=some), grouped).recordings if some else some
        for some in (recordings, after)
    )
    unlike = {name: (old, new) for name, old, new in pages.beside(*pages.differing(before, now)) if old != new}
    expected = {name for name in {*recordings, *after} if recordings.get(name) != after.get(name)}
    assert set(unlike) == expected
    assert all(unlike[name] == (recordings.get(name), after.get(name)) for name in expected)


def test_one_more_recording_leaves_all_pages_but_its_own_as_they_were() -> None:
    recordings = {f"trial-{number:05d}": ENTRY for number in range(3_000)}
    before, now = (
        paged(Manifest("stage", 1, recordings=some), pages.GROUPED).recordings
        for some in (recordings, {**recordings, "trial-01500-again": ENTRY})
    )
    assert isinstance(before, pages.Pages) and isinstance(now, pages.Pages)
    assert len(before.texts) > 4
    assert len(now.texts) - len(pages.shared(before, now)) <= 2


@given(MANY, st.sampled_from([None, ("*",)]), st.integers(1, 5))
@example(COLON, None, 1)
def test_a_key_made_of_text_is_the_key_made_of_what_was_parsed(
    recordings: dict[str, Any], reads: tuple[str, ...] | None, grouped: int
) -> None:
    whole = Manifest("stage", 1, recordings=recordings)
    found = paged(whole, grouped)
    assert found.digest == whole.digest
    by_value = keys.of_dataset(whole, reads, whole.included)
    if not whole.included:
        return
    by_text = keys.of_dataset(found, reads, found.included)
    kept = by_text["recordings"]
    assert isinstance(kept, Described)
    assert hashing.canonical({"b": by_text, "a": 1}) == hashing.canonical({"b": by_value, "a": 1})
    assert hashing.digest(by_text) == hashing.digest(by_value)
    assert dict(kept) == by_value["recordings"]
    assert dict(pickle.loads(pickle.dumps(kept))) == by_value["recordings"]


def test_of_text_that_tacpipe_would_not_write_a_key_is_made_of_what_was_parsed(few_are_many: None) -> None:
    whole = Manifest("stage", 1, recordings={name: {**ENTRY, "attributes": {"n": 1.5}} for name in "abcdef"})
    content = whole.content.replace(b'"n": 1.5', b'"n": 1.50', 1)
    found = manifest.parse(content, "given")
    assert found.digest == whole.digest and isinstance(found.recordings, pages.Pages)
    by_text, by_value = (keys.of_dataset(one, None, one.included) for one in (found, whole))
    assert not isinstance(by_text["recordings"], Described)
    assert hashing.digest(by_text) == hashing.digest(by_value)
