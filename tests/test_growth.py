"""One more recording costs the same however many there are, counted in reads and writes."""

from pathlib import Path

import pytest

import tacpipe
from tacpipe.datasets import manifest, pages
from tacpipe.errors import DamagedError
from tacpipe.store.records import summary
from tacpipe.store.store import Store
from tests.conftest import FileCalls, Lab

GROUPED, COUNT = 4, 40


def placed_shards(file_calls: FileCalls) -> list[str]:
    return [path for path in file_calls.named if "/data/" in path and path.endswith(".parquet")]


def test_one_more_recording_reads_the_records_of_its_group_and_places_its_own_files(
    lab: Lab, file_calls: FileCalls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "GROUPED", GROUPED)
    lab.run(f"simulate toy --rows 2 --trials {COUNT} -o data/toy")
    lab.run("scale data/toy -o data/scaled --jobs 1")
    names = list(tacpipe.open(lab.folder / "data/toy").recordings)
    sizes = [len(group) for group in pages.group_names(names)]
    assert max(sizes) < COUNT / 2
    before = {path: path.stat().st_ino for path in (lab.folder / "data/toy").rglob("*.parquet")}

    file_calls.clear()
    lab.run(f"simulate toy --rows 2 --trials {COUNT + 1} -o data/toy --jobs 1")
    assert len(placed_shards(file_calls)) == 2  # the streams of the new one
    assert {path: path.stat().st_ino for path in before} == before

    file_calls.clear()
    ran = lab.run("scale data/toy -o data/scaled --jobs 1 --json")
    assert len(placed_shards(file_calls)) == 1
    assert file_calls.take("records") < len(sizes) + 2 * (max(sizes) + 1) + 8 < COUNT
    assert f'"reused": {COUNT}' in ran.out and '"ran": 1,' in ran.out


def test_groups_hold_every_recording_and_the_results_are_those_without_groups(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy --trials 9 -o data/toy")
    lab.run("scale data/toy -o alone")
    monkeypatch.setattr(pages, "GROUPED", 2)
    lab.run("label data/toy trial-003 --set material=felt")
    lab.run("scale data/toy -o first --jobs 1")
    lab.run("label data/toy trial-003 --set material=silk")
    ran = lab.run("scale data/toy -o again --jobs 1")

    assert "0 ran, 9 reused" in ran.err
    entries = {place: tacpipe.open(lab.folder / place).source.recordings for place in ("alone", "first", "again")}
    assert entries["again"]["trial-003"]["attributes"]["material"] == "silk"
    for name, entry in entries["alone"].items():
        assert entry["shards"] == entries["first"][name]["shards"] == entries["again"][name]["shards"]


def test_a_lost_object_of_a_group_is_computed_again_and_nothing_else_is(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "GROUPED", GROUPED)
    lab.run("simulate toy --rows 2 --trials 12 -o data/toy")
    lab.run("scale data/toy -o data/scaled --jobs 1")
    shard = tacpipe.open(lab.folder / "data/scaled").recordings["trial-005"].digest
    Path(Store(lab.folder / ".tacpipe").object_path(shard)).unlink()

    assert "1 ran, 11 reused" in lab.run("scale data/toy -o data/scaled --jobs 1").err
    assert "0 ran" in lab.run("scale data/toy -o data/scaled --jobs 1").err


def test_a_file_that_is_gone_or_has_another_size_is_placed_again_when_another_recording_comes(lab: Lab) -> None:
    lab.run("simulate toy --trials 3 -o data/toy")
    lab.run("scale data/toy -o data/scaled")
    content = {path: path.read_bytes() for path in sorted((lab.folder / "data/scaled").glob("*.parquet"))}
    removed, cut, _ = content
    removed.unlink()
    cut.unlink()
    cut.write_bytes(b"cut")
    lab.run("simulate toy --trials 4 -o data/toy")
    lab.run("scale data/toy -o data/scaled")

    assert {path: path.read_bytes() for path in content} == content


def test_the_provenance_of_a_group_keeps_what_its_stage_noted(lab: Lab) -> None:
    lab.run("simulate toy --trials 3 -o data/toy")
    lab.run("scale data/toy -o data/scaled --jobs 1")
    store = Store(lab.folder / ".tacpipe")
    (group,) = [record for _, record in store.records() if "group" in record["identity"]]
    singles = [record for _, record in store.records() if record["identity"].get("stage") == "scale"]

    assert summary(group)["code"] == {"scale": {singles[0]["provenance"]["code"]: 3}}
    assert set(group["result"]["recordings"]) == {"trial-000", "trial-001", "trial-002"}


def test_a_manifest_that_was_edited_is_refused_though_the_sound_one_was_read(lab: Lab) -> None:
    lab.run("simulate toy --trials 1 -o data/toy")
    content = (lab.folder / "data/toy/manifest.json").read_bytes()
    edited = content.replace(b'"cork"', b'"felt"')
    assert manifest.parse(edited, "edited", verified=True).recordings != manifest.parse(content, "sound").recordings

    with pytest.raises(DamagedError):
        manifest.parse(edited, "edited")
