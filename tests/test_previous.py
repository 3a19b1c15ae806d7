"""A run over a dataset in which few recordings changed reuses the previous run, with the bytes of a first run."""

import json
import os
import random
import shlex
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.datasets import directory, lineage, manifest, pages
from tacpipe.engine.previous import Previous, Reusable
from tacpipe.errors import DAMAGED
from tacpipe.io.hashing import file_digest
from tacpipe.store import presence, records
from tacpipe.store.location import locate
from tacpipe.store.records import Summary
from tests.conftest import FileCalls, Lab
from tests.test_presence import DAY_NS, FAULTS

NAMED = "named data/r -o data/s --jobs 1"
TRIALS = 14
MATERIALS = ("felt", "silk", "cork")
NOTES = ("a", 'say ": this', "é", "\\", "a\nb")


@pytest.fixture
def reused_counts(few_are_many: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """How many results each command took over; all datasets are large, a group has two recordings in the mean."""
    counts: list[int] = []
    take = Previous.reusable

    def taking(self: Previous, *arguments: Any) -> Reusable | None:
        previous_results = take(self, *arguments)
        counts.append(0 if previous_results is None else previous_results.count)
        return previous_results

    monkeypatch.setattr(Previous, "reusable", taking)
    yield counts


@pytest.fixture(params=["settled", "unsettled"])
def clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """All folders changed long ago, or a moment ago, so that their times are not noted."""
    clock_ns, ago_ns = presence.Look._clock_ns, DAY_NS if request.param == "settled" else -DAY_NS
    monkeypatch.setattr(presence.Look, "_clock_ns", lambda self: clock_ns(self) + ago_ns)


def digests(folder: Path) -> dict[str, str]:
    """Return the digests of the files of a dataset by path, and the rows that were read for it."""
    paths = {str(path.relative_to(folder)): file_digest(path) for path in sorted(folder.rglob("*")) if path.is_file()}
    if not (folder / manifest.NAME).exists():
        return paths
    store = locate(folder)
    counted = lineage.counted_rows(store, manifest.find(folder).manifest, directory.stored_key(store, folder))
    return {**paths, "rows": json.dumps(counted, sort_keys=True)}


def first_run(lab: Lab, place: Path, command: str) -> dict[str, str]:
    """Return what the command gives of the same dataset in a project of its own, whose store is empty."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(lab.folder / "data/r", place / "data/r")
    (place / ".tacpipe").mkdir()
    parsed = dict(manifest._parsed)
    manifest._parsed.clear()
    os.chdir(place)
    try:
        lab.run(command)
    finally:
        os.chdir(lab.folder)
        manifest._parsed.clear()
        manifest._parsed.update(parsed)
    return digests(place / "data/s")


def change(lab: Lab, chance: random.Random) -> None:
    """Change the recordings in one of the ways in which commands do."""
    names = [path.name for path in (lab.folder / "data/r").iterdir() if path.is_dir()]
    changed_names = chance.sample(sorted(names), chance.randint(1, 3))
    kind = chance.choice(["more", "one", "several", "excluded", "included", "all"])
    if kind == "more":
        lab.run(f"simulate toy --rows 3 --trials {len(names) + chance.randint(1, 3)} -o data/r --jobs 1")
    elif kind == "one":
        lab.run(f"label data/r {changed_names[0]} --set material={chance.choice(MATERIALS)}")
    elif kind == "several":
        lab.run(f"label data/r {' '.join(changed_names)} --set note={shlex.quote(chance.choice(NOTES))}")
    elif kind == "excluded":
        lab.run(f"label data/r {' '.join(changed_names)} --exclude dropped")
    elif kind == "included":
        lab.run("label data/r '*' --include")
    else:
        lab.run(f"label data/r '*' --set batch={chance.randint(1, 3)}")


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("seed", range(4))
def test_a_run_over_a_changed_dataset_gives_the_bytes_of_a_first_run_in_an_empty_store(
    lab: Lab, reused_counts: list[int], tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    chance, folder = random.Random(seed), tmp_path_factory.mktemp("other")
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    for _ in range(8):
        change(lab, chance)
        if chance.random() < 0.3:
            change(lab, chance)
        if chance.random() < 0.2:
            manifest._parsed.clear()  # a command is a process of its own
        lab.run(NAMED)
        assert digests(lab.folder / "data/s") == first_run(lab, folder / "first", NAMED)
        assert '"ran": 0' in lab.run(f"{NAMED} --json").out
    assert max(reused_counts) >= TRIALS // 2
    shutil.rmtree(lab.folder / ".tacpipe/presence")
    assert '"ran": 0' in lab.run(f"{NAMED} --json").out  # each file is looked at
    lab.run("store verify")


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: str(fault.__name__))
def test_what_is_lost_is_found_by_the_run_that_takes_over_the_rest(
    lab: Lab, reused_counts: list[int], fault: Callable[[Lab], None], tmp_path_factory: pytest.TempPathFactory
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    lab.run("label data/r trial-009 --set material=felt")
    lab.run(NAMED)
    assert reused_counts[-1] > 0
    lab.run("label data/r trial-010 --set material=silk")
    fault(lab)
    manifest._parsed.clear()
    lab.run(NAMED)
    lab.run("store verify")
    assert digests(lab.folder / "data/s") == first_run(lab, tmp_path_factory.mktemp("other") / "first", NAMED)


def test_of_a_dataset_of_which_one_recording_changed_no_other_group_is_asked_for(
    lab: Lab, reused_counts: list[int], file_calls: FileCalls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pages, "GROUPED", 4)
    count = 60
    lab.run(f"simulate toy --rows 2 --trials {count} -o data/r --jobs 1")
    lab.run(NAMED)
    lab.run("label data/r trial-030 --set material=felt")
    sizes = [len(group) for group in pages.group_names(f"trial-{number:03d}" for number in range(count))]
    file_calls.clear()
    ran = lab.run_json(NAMED)

    assert (ran["ran"], ran["reused"]) == (1, count - 1)
    assert reused_counts[-1] >= count - max(sizes)
    assert file_calls.take("records") < max(sizes) + 10 < count / 2


def test_while_results_are_taken_over_a_collection_sees_the_manifests_that_name_them(
    lab: Lab, reused_counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    before = {file_digest(lab.folder / place / "manifest.json") for place in ("data/r", "data/s")}
    lab.run("label data/r trial-003 --set material=felt")
    named_manifests: list[set[str]] = []
    holds = presence.Look.holds

    def record_manifests(self: presence.Look, *arguments: Any, **options: Any) -> bool:
        named_manifests.append({name for run in lab.store.leases.runs() for name in run.manifests})
        return holds(self, *arguments, **options)

    monkeypatch.setattr(presence.Look, "holds", record_manifests)
    lab.run(NAMED)
    assert reused_counts[-1] > 0
    assert named_manifests and before <= named_manifests[-1]


def test_what_records_state_of_results_is_the_same_with_and_without_a_previous_run(
    lab: Lab, reused_counts: list[int]
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    lab.run("label data/r trial-003 --set material=felt")
    lab.run(NAMED)
    assert reused_counts[-1] > 0

    def run_provenance() -> Any:
        summary = _run_summary(lab)
        return {"code": summary["code"], "notes": summary["notes"]}

    by_taking = run_provenance()
    shutil.rmtree(lab.folder / ".tacpipe/presence")
    lab.run(f"{NAMED} --rerun")
    assert by_taking == run_provenance()
    assert sum(by_taking["code"]["named"].values()) == TRIALS


def test_results_of_different_code_are_reused_and_counted_by_code(
    lab: Lab, reused_counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    from tacpipe.engine import provenance

    names = [f"trial-{number:03d}" for number in range(TRIALS)]
    (first_code,) = _run_summary(lab)["code"]["named"]
    code_by_name = dict.fromkeys(names, first_code)
    chance = random.Random(0)
    for version in range(6):
        code = str(version) * 64
        monkeypatch.setattr(provenance, "code", lambda stage, code=code: code)
        changed_names = chance.sample(names, chance.randint(1, 2))
        lab.run(f"label data/r {' '.join(changed_names)} --set material={version}")
        ran = lab.run_json(NAMED)
        assert reused_counts[-1] > 0
        assert (ran["ran"], ran["reused"]) == (len(changed_names), TRIALS - len(changed_names))
        code_by_name |= dict.fromkeys(changed_names, code)
        assert _run_summary(lab)["code"]["named"] == Counter(code_by_name.values())


def _run_summary(lab: Lab) -> Summary:
    """Return the summary of results in the record of the run that wrote data/s."""
    manifest_digest = file_digest(lab.folder / "data/s/manifest.json")
    (run,) = [record for _, record in lab.store.records() if manifest_digest in records.digests(record["result"])]
    return records.summary(run)


def test_nothing_is_reused_if_the_code_of_replaced_results_is_unknown(
    lab: Lab, reused_counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    from tacpipe.engine import provenance

    monkeypatch.setattr(provenance, "code", lambda stage: "0" * 64)
    lab.run("label data/r trial-003 --set material=felt")
    lab.run(NAMED)
    for path, record in [*lab.store.records()]:
        if "run" not in record["identity"]:
            Path(lab.store.record_path(path)).unlink()
    lab.run("label data/r trial-004 --set material=felt")
    assert lab.run_json(NAMED)["ran"] == TRIALS
    assert reused_counts[-1] == 0


@pytest.mark.parametrize("number", [0, -1])
def test_a_manifest_that_lists_pages_and_was_edited_by_hand_is_refused(
    lab: Lab, reused_counts: list[int], number: int
) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run(NAMED)
    lab.run("label data/r trial-003 --set material=felt")
    file = lab.folder / "data/r/manifest.json"
    root = json.loads(file.read_bytes())
    root["pages"][number]["content"] = "0" * 64
    file.write_text(json.dumps(root))
    before = digests(lab.folder / "data/s")
    ran = lab.call(NAMED)
    assert ran.code == DAMAGED
    assert "edited by hand" in ran.err
    assert digests(lab.folder / "data/s") == before


def test_another_stage_and_other_params_take_over_nothing(lab: Lab, reused_counts: list[int]) -> None:
    lab.run(f"simulate toy --rows 3 --trials {TRIALS} -o data/r --jobs 1")
    lab.run("scale data/r -o data/s --factor 2 --jobs 1")
    lab.run("scale data/r -o data/s --factor 3 --jobs 1")
    assert reused_counts[-1] == 0
    lab.run(f"{NAMED} --replace")
    assert reused_counts[-1] == 0
