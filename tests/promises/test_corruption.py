"""Damage of any kind to any file of a project: never served, named, and healed where that is possible."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tacpipe.errors import DAMAGED
from tests.conftest import Lab
from tests.promises import damages, specimen
from tests.promises.counts import count
from tests.promises.specimen import Specimen

TARGETS: dict[str, Callable[[Specimen], Path]] = {
    "the object of a recording": lambda one: one.object("recordings", "a/left.parquet"),
    "the object of a simulated stream": lambda one: one.object("simulated", "trial-001/left.parquet"),
    "the object of a shard": lambda one: one.object("scaled", "b.parquet"),
    "the object of a shard of a fitted stage": lambda one: one.object("centred", "c.parquet"),
    "the object of a codec": lambda one: one.object("centred", "codec.json"),
    "the object of a split": lambda one: one.object("split", "split.parquet"),
    "the object of a file": lambda one: one.object("total", "metrics.json"),
    "the object of a manifest": lambda one: one.object("scaled", ""),
    "the object of a labelled manifest": lambda one: one.object("recordings", ""),
    "the record of a recording": lambda one: one.records("ingest.numbers")[0],
    "the record of a shard": lambda one: one.records("scale")[1],
    "the record of a fit": lambda one: one.records("centre.fit")[0],
    "the record of a whole dataset": lambda one: one.records("total")[0],
    "the record of a run": lambda one: one.records("scale", of="run")[0],
    "the root of recordings": lambda one: one.lab.store.root / "roots" / root_of(one, "recordings"),
    "the root of a dataset": lambda one: one.lab.store.root / "roots" / root_of(one, "scaled"),
    "the manifest of recordings": lambda one: one.folder / "data/recordings/manifest.json",
    "the manifest of a dataset": lambda one: one.folder / "data/scaled/manifest.json",
    "the manifest of a last dataset": lambda one: one.folder / "data/centred/manifest.json",  # nothing descends from it
    "the copy of a recording": lambda one: one.folder / "data/recordings/b/left.parquet",
    "the link of a shard": lambda one: one.folder / "data/scaled/c.parquet",
    "the link of a file": lambda one: one.folder / "data/total/metrics.json",
}
FOUND = ("the object", "the record", "the root")  # what `store verify` looks at
NEEDED = "the object"  # what it misses where it is gone
SILENT = (
    "a bit is flipped",
    "its first bit is flipped",
    "its last bit is flipped",
    "a byte is changed and no time",
    "it is all zeros",
    "another file is in its place",
)  # the size stays
QUICK = [(target, list(damages.ALL)[number % len(damages.ALL)]) for number, target in enumerate(TARGETS)]


def root_of(one: Specimen, dataset: str) -> str:
    for path in (one.store / "roots").iterdir():
        if json.loads(path.read_text())["path"].endswith(f"data/{dataset}"):
            return path.name
    raise AssertionError(dataset)


def harmed(one: Specimen, target: str, damage: str) -> str:
    """Harm one file; return what a finding about it should name."""
    path = TARGETS[target](one)
    damages.ALL[damage](path)
    count("corruptions found")
    return path.name.partition(".")[0]


def served_right_or_refused(one: Specimen, target: str, damage: str) -> None:
    harmed(one, target, damage)
    served = one.served()
    assert all(served.values()) or target.startswith("the manifest")  # everything else is made again, or adopted
    ran = one.lab.call("scale data/recordings -o data/other --factor 9 --jobs 1")
    if ran.code == 0:
        found = specimen.held(one.folder / "data/other")
        assert {name: values_of(bits) for name, bits in found.items()} == {
            f"{name}.parquet": [9 * (value + 5 * number) for value in range(10)] for number, name in enumerate("abc")
        }
    else:
        assert ran.code in (DAMAGED, 2) and target == "the manifest of recordings", ran
    assert "Traceback" not in ran.err


def values_of(bits: list[tuple[object, ...]]) -> object:
    return bits[0][-1]


def verified_and_repaired(one: Specimen, target: str, damage: str) -> None:
    name = harmed(one, target, damage)
    found = one.lab.call("store verify")
    if target.startswith(FOUND) and (damage != "it is gone" or target.startswith(NEEDED)):
        assert found.code == DAMAGED and name in found.out, found
    elif not target.startswith(("the link", "the manifest")):  # these lie beside the store; a link may be the object
        assert found.code == 0, found
    assert one.lab.call("store repair").code == 0
    sound(one)
    assert all(one.served().values()) or (damage == "it is gone" and target.startswith("the manifest"))


def healed_by_a_rerun(one: Specimen, target: str, damage: str) -> None:
    harmed(one, target, damage)
    if damage in SILENT and target.startswith(("the object", "the link")):  # a link may be the object itself
        one.lab.call("store verify")  # an answer from the store looks at sizes; only who reads looks at bytes
    for ran in one.rerun():
        assert ran.code == 0, ran
    wanted = dict(one.sound)
    if (target, damage) == ("the manifest of recordings", "it is gone"):  # who removes it does without its labels
        wanted = {path: content for path, content in wanted.items() if not path.endswith("manifest.json")}
    assert {path: content for path, content in one.shown().items() if path in wanted} == wanted
    if len(wanted) < len(one.sound):  # other labels, other manifests
        return
    assert one.lab.call("store repair").code == 0  # what no rerun had to look at, as the record of a shard
    sound(one)


def sound(one: Specimen) -> None:
    """Look whether everything is sound, and a collection finds nothing to take."""
    verified = one.lab.call("store verify")
    assert verified.code == 0 and "all sound" in verified.out, verified
    collected = one.lab.call("store gc")
    assert collected.code == 0, collected
    assert one.needed() <= {path.name for path in specimen.beneath(one.store / "objects")}


PROMISES = {
    promise.__name__: promise for promise in (served_right_or_refused, verified_and_repaired, healed_by_a_rerun)
}


@pytest.mark.parametrize("promise", PROMISES)
@pytest.mark.parametrize(("target", "damage"), QUICK)
def test_one_damaged_file(one: Specimen, target: str, damage: str, promise: str) -> None:
    PROMISES[promise](one, target, damage)


@pytest.mark.faults
@pytest.mark.parametrize("promise", PROMISES)
@pytest.mark.parametrize("target", TARGETS)
def test_one_file_damaged_in_each_way(made: Path, lab: Lab, target: str, promise: str) -> None:
    for damage in damages.ALL:
        PROMISES[promise](specimen.copy(made, lab), target, damage)


# ---- collections, while something is damaged


MANIFESTS = [target for target in TARGETS if "manifest" in target]


def collected_without_loss(one: Specimen, target: str, damage: str) -> None:
    name = harmed(one, target, damage)
    specimen.age(one.folder)
    ran = one.lab.call("store gc --recordings --grace-days 0")
    assert ran.code in (0, DAMAGED) and "Traceback" not in ran.err, ran
    left = {path.name for path in specimen.beneath(one.store / "objects")}
    assert one.needed() - left <= {name}  # the damaged one itself
    assert one.lab.call("store repair").code == 0
    for ran in one.rerun():
        assert ran.code == 0, ran
    assert one.shown() == dict(one.sound)


@pytest.mark.parametrize("damage", ["a bit is flipped", "it is empty"])
@pytest.mark.parametrize("target", [*MANIFESTS, "the root of a dataset"])
def test_a_collection_takes_nothing_of_a_dataset_whose_manifest_or_root_is_damaged(
    one: Specimen, target: str, damage: str
) -> None:
    collected_without_loss(one, target, damage)


@pytest.mark.faults
@pytest.mark.parametrize("target", TARGETS)
def test_a_collection_takes_nothing_that_is_needed_whatever_is_damaged(made: Path, lab: Lab, target: str) -> None:
    for damage in damages.ALL:
        if damage != "it is gone" or not target.startswith("the manifest"):  # who removes one drops the dataset
            collected_without_loss(specimen.copy(made, lab), target, damage)
