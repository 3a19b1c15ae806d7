"""Looking at a store while a collection removes things from it reports nothing that vanished as damaged."""

import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.maintenance import garbage, repair
from tacpipe.maintenance import status as statuses
from tacpipe.store import layout
from tacpipe.store.backend import Entry
from tacpipe.store.store import Store
from tests.conftest import Lab
from tests.test_garbage import age


@pytest.fixture
def littered(lab: Lab) -> Lab:
    """A project with objects and records that nothing needs."""
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    lab.run("scale data/r -o data/s --factor 5")
    age(lab)
    return lab


def between(monkeypatch: pytest.MonkeyPatch, folder: str, act: Callable[[], object]) -> list[int]:
    """Have ``act`` done once, after the next listing of ``folder`` and before its first name is looked at."""
    list_names = layout.names
    listed_counts: list[int] = []

    def names(root: Path, name: str, note_denied: layout.NoteDenied) -> Iterator[str]:
        listed_names = list(list_names(root, name, note_denied))
        if name == folder and not listed_counts:
            listed_counts.append(len(listed_names))
            act()
        return iter(listed_names)

    monkeypatch.setattr(layout, "names", names)
    return listed_counts


@pytest.mark.parametrize("folder", ["objects", "records"])
def test_what_a_collection_removed_since_it_was_listed_is_not_damaged(
    littered: Lab, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    collected: list[garbage.Collected] = []
    store = littered.store
    listed_counts = between(
        monkeypatch, folder, lambda: collected.append(garbage.collect(Store(store.root), dry_run=False))
    )
    soundness = repair.verify(store)
    removed_count = collected[0].objects if folder == "objects" else collected[0].records
    assert removed_count > 0 and listed_counts[0] - removed_count == (
        soundness.objects if folder == "objects" else soundness.records
    )
    assert soundness.clean and soundness.damaged == soundness.missing == []


def test_what_a_collection_has_moved_aside_is_sound(littered: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    store = littered.store
    path = next(layout.entries(store.root, "objects"))
    between(monkeypatch, "objects", lambda: path.rename(store.aside_path(path.name)))
    assert repair.verify(store).clean


def test_what_was_damaged_once_and_is_collected_now_is_not_damaged_again(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = littered.store
    path = next(layout.entries(store.root, "objects"))
    shutil.copy(path, store.root / "quarantine" / f"{path.name}.1")
    between(monkeypatch, "objects", path.unlink)
    assert path.name not in repair.verify(store).damaged


def test_what_is_there_and_does_not_hash_to_its_name_is_damaged_beside_a_collection_too(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = littered.store
    path = Path(store.object_path(littered.manifest("data/s").recordings["trial-000"]["shards"][""]["digest"]))
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    age(littered)
    between(monkeypatch, "objects", lambda: garbage.collect(Store(store.root), dry_run=False))
    assert repair.verify(store).damaged == [path.name]


def test_a_root_that_was_forgotten_since_it_was_listed_is_not_damaged(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = littered.store
    honest = store.roots.read

    def read(file: Path) -> Any:
        file.unlink(missing_ok=True)
        return honest(file)

    monkeypatch.setattr(store.roots, "read", read)
    assert repair.verify(store).clean


def test_what_a_root_named_at_the_first_look_and_no_more_at_the_second_is_not_missing(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = repair._absent_objects
    looks: list[dict[str, str]] = []

    def with_another(store: Store, soundness: repair.Soundness, present: Collection[str] = ()) -> dict[str, str]:
        looks.append(honest(store, soundness, present))
        return {**looks[-1], **({"ab" * 32: "manifest.json"} if len(looks) == 1 else {})}

    monkeypatch.setattr(repair, "_absent_objects", with_another)
    assert repair.verify(littered.store).clean and len(looks) == 2


def test_a_status_beside_a_collection_counts_what_it_still_finds(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, honest = littered.store, os.walk
    draft = store.root / "tmp" / f".{'ab' * 16}"
    draft.write_bytes(b"touch")
    removed: list[Path] = []

    def walk(folder: Path, **options: Any) -> Iterator[Any]:
        for place, folders, files in honest(folder, **options):
            if place.endswith("objects"):  # a shelf goes after it was listed
                removed.append(Path(place) / folders[0])
                shutil.rmtree(removed[-1])
            for file in files if place.endswith("tmp") else ():
                removed.append(Path(place) / file)
                removed[-1].unlink()
            yield place, folders, files

    before = statuses.status(store)
    monkeypatch.setattr(os, "walk", walk)
    status = statuses.status(store)
    assert draft in removed and len(removed) == 2
    assert status["tmp"]["files"] == 0 < status["objects"]["files"] < before["objects"]["files"]


def test_a_dry_run_beside_a_collection_counts_what_it_still_finds(
    littered: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = littered.store
    honest = store.entries
    collections: list[garbage.Collected] = []

    def entries(names: Iterable[str]) -> dict[str, Entry]:
        collections.append(garbage.collect(Store(store.root), dry_run=False))
        return honest(names)

    monkeypatch.setattr(store, "entries", entries)
    assert garbage.collect(store, dry_run=True).objects == 0 < collections[0].objects
