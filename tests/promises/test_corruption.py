"""Test that damage to any file of a project is never served, is reported, and is repaired if possible."""

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
    "the object of a recording": lambda project: project.object("recordings", "a/left.parquet"),
    "the object of a simulated stream": lambda project: project.object("simulated", "trial-001/left.parquet"),
    "the object of a shard": lambda project: project.object("scaled", "b.parquet"),
    "the object of a shard of a fitted stage": lambda project: project.object("centred", "c.parquet"),
    "the object of a codec": lambda project: project.object("centred", "codec.json"),
    "the object of a split": lambda project: project.object("split", "split.parquet"),
    "the object of a file": lambda project: project.object("total", "metrics.json"),
    "the object of a manifest": lambda project: project.object("scaled", ""),
    "the object of a labelled manifest": lambda project: project.object("recordings", ""),
    "the record of a recording": lambda project: project.records("ingest.numbers")[0],
    "the record of a shard": lambda project: project.records("scale")[1],
    "the record of a fit": lambda project: project.records("centre.fit")[0],
    "the record of a whole dataset": lambda project: project.records("total")[0],
    "the record of a run": lambda project: project.records("scale", identity_key="run")[0],
    "the root of recordings": lambda project: project.lab.store.root / "roots" / root_of(project, "recordings"),
    "the root of a dataset": lambda project: project.lab.store.root / "roots" / root_of(project, "scaled"),
    "the manifest of recordings": lambda project: project.folder / "data/recordings/manifest.json",
    "the manifest of a dataset": lambda project: project.folder / "data/scaled/manifest.json",
    "the manifest of a last dataset": lambda project: (
        project.folder / "data/centred/manifest.json"
    ),  # nothing descends from it
    "the copy of a recording": lambda project: project.folder / "data/recordings/b/left.parquet",
    "the link of a shard": lambda project: project.folder / "data/scaled/c.parquet",
    "the link of a file": lambda project: project.folder / "data/total/metrics.json",
}
FOUND = ("the object", "the record", "the root")  # `store verify` looks at these.
NEEDED = "the object"  # `store verify` reports these if they are deleted.
SILENT = (
    "a bit is flipped",
    "its first bit is flipped",
    "its last bit is flipped",
    "a byte is changed and no time",
    "it is all zeros",
    "another file is in its place",
)  # the size stays
QUICK = [(target, list(damages.ALL)[number % len(damages.ALL)]) for number, target in enumerate(TARGETS)]


def root_of(project: Specimen, dataset: str) -> str:
    for path in (project.store / "roots").iterdir():
        if json.loads(path.read_text())["path"].endswith(f"data/{dataset}"):
            return path.name
    raise AssertionError(dataset)


def harm(project: Specimen, target: str, damage: str) -> str:
    """Harm one file; return what a finding about it should name."""
    path = TARGETS[target](project)
    damages.ALL[damage](path)
    count("corruptions found")
    return path.name.partition(".")[0]


def check_served_or_refused(project: Specimen, target: str, damage: str) -> None:
    harm(project, target, damage)
    served = project.served()
    assert all(served.values()) or target.startswith("the manifest")  # everything else is made again, or adopted
    ran = project.lab.call("scale data/recordings -o data/other --factor 9 --jobs 1")
    if ran.code == 0:
        contents = specimen.read_content(project.folder / "data/other")
        assert {name: values_of(bits) for name, bits in contents.items()} == {
            f"{name}.parquet": [9 * (value + 5 * number) for value in range(10)] for number, name in enumerate("abc")
        }
    else:
        assert ran.code in (DAMAGED, 2) and target == "the manifest of recordings", ran
    assert "Traceback" not in ran.err


def values_of(bits: list[tuple[object, ...]]) -> object:
    return bits[0][-1]


def check_verify_and_repair(project: Specimen, target: str, damage: str) -> None:
    name = harm(project, target, damage)
    verified = project.lab.call("store verify")
    if target.startswith(FOUND) and (damage != "it is gone" or target.startswith(NEEDED)):
        assert verified.code == DAMAGED and name in verified.out, verified
    elif not target.startswith(("the link", "the manifest")):  # these lie beside the store; a link may be the object
        assert verified.code == 0, verified
    assert project.lab.call("store repair").code == 0
    check_sound(project)
    assert all(project.served().values()) or (damage == "it is gone" and target.startswith("the manifest"))


def check_rerun_heals(project: Specimen, target: str, damage: str) -> None:
    harm(project, target, damage)
    if damage in SILENT and target.startswith(("the object", "the link")):  # a link may be the object itself
        project.lab.call("store verify")  # an answer from the store looks at sizes; only who reads looks at bytes
    for ran in project.rerun():
        assert ran.code == 0, ran
    expected = dict(project.sound)
    if (target, damage) == ("the manifest of recordings", "it is gone"):  # Deleting it gives up its labels.
        expected = {path: content for path, content in expected.items() if not path.endswith("manifest.json")}
    assert {path: content for path, content in project.data_files().items() if path in expected} == expected
    if len(expected) < len(project.sound):  # other labels, other manifests
        return
    assert (
        project.lab.call("store repair").code == 0
    )  # A rerun may not look at all files, such as the record of a shard.
    check_sound(project)


def check_sound(project: Specimen) -> None:
    """Look whether everything is sound, and a collection finds nothing to take."""
    verified = project.lab.call("store verify")
    assert verified.code == 0 and "all sound" in verified.out, verified
    collected = project.lab.call("store gc")
    assert collected.code == 0, collected
    assert project.needed() <= {path.name for path in specimen.beneath(project.store / "objects")}


PROMISES = {
    promise.__name__: promise for promise in (check_served_or_refused, check_verify_and_repair, check_rerun_heals)
}


@pytest.mark.parametrize("promise", PROMISES)
@pytest.mark.parametrize(("target", "damage"), QUICK)
def test_one_damaged_file(project: Specimen, target: str, damage: str, promise: str) -> None:
    PROMISES[promise](project, target, damage)


@pytest.mark.faults
@pytest.mark.parametrize("promise", PROMISES)
@pytest.mark.parametrize("target", TARGETS)
def test_one_file_damaged_in_each_way(original: Path, lab: Lab, target: str, promise: str) -> None:
    for damage in damages.ALL:
        PROMISES[promise](specimen.copy(original, lab), target, damage)


# ---- collections, while something is damaged


MANIFESTS = [target for target in TARGETS if "manifest" in target]


def check_collection_loses_nothing(project: Specimen, target: str, damage: str) -> None:
    name = harm(project, target, damage)
    specimen.age(project.folder)
    ran = project.lab.call("store gc --recordings --grace-days 0")
    assert ran.code in (0, DAMAGED) and "Traceback" not in ran.err, ran
    remaining = {path.name for path in specimen.beneath(project.store / "objects")}
    assert project.needed() - remaining <= {name}  # the damaged one itself
    assert project.lab.call("store repair").code == 0
    for ran in project.rerun():
        assert ran.code == 0, ran
    assert project.data_files() == dict(project.sound)


@pytest.mark.parametrize("damage", ["a bit is flipped", "it is empty"])
@pytest.mark.parametrize("target", [*MANIFESTS, "the root of a dataset"])
def test_a_collection_takes_nothing_of_a_dataset_whose_manifest_or_root_is_damaged(
    project: Specimen, target: str, damage: str
) -> None:
    check_collection_loses_nothing(project, target, damage)


@pytest.mark.faults
@pytest.mark.parametrize("target", TARGETS)
def test_a_collection_takes_nothing_that_is_needed_whatever_is_damaged(original: Path, lab: Lab, target: str) -> None:
    for damage in damages.ALL:
        if damage != "it is gone" or not target.startswith("the manifest"):  # Deleting a manifest drops its dataset.
            check_collection_loses_nothing(specimen.copy(original, lab), target, damage)
