import json
import os
import time
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tacpipe
from tacpipe import upkeep
from tests.conftest import Lab
from tests.test_pipeline import counts, replace_stream


def age(lab: Lab, days: float = 30.0) -> None:
    """Make everything in the store look old."""
    then = time.time() - days * 86400
    for path in lab.store.root.rglob("*"):
        if path.is_file():
            os.utime(path, (then, then))


def collected(lab: Lab, options: str = "") -> dict[str, int]:
    value: dict[str, int] = json.loads(lab.run(f"store gc --json {options}").out)
    return value


def test_nothing_that_a_root_or_its_ancestors_need_is_removed(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("total data/s -o data/t")
    age(lab)
    assert collected(lab)["objects"] == 0
    assert counts(lab.run("total data/s -o data/t --json").out) == (0, 1)


def test_what_an_output_held_before_is_removed_and_a_dry_run_only_counts(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    lab.run("scale data/r -o data/s --factor 3")
    age(lab)
    dry = collected(lab, "--dry-run")
    assert dry["objects"] == 4  # a manifest and three shards: three times two is two times three, and stays
    assert collected(lab) == {**dry, "drafts": dry["drafts"]}
    assert upkeep.verify(lab.store).clean
    assert counts(lab.run("scale data/r -o data/s --factor 3 --json").out) == (0, 4)
    ran, reused = counts(lab.run("scale data/r -o data/s --factor 2 --json").out)
    assert ran + reused == 4 and ran >= 3


def test_young_objects_and_those_of_a_running_process_are_kept(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    lab.run("scale data/r -o data/s --factor 3")
    assert collected(lab)["objects"] == 0  # seconds old: somebody may be about to name them
    manifest = lab.manifest("data/s")
    lab.run("scale data/r -o data/s --factor 5")
    age(lab)
    from tacpipe.hashing import bytes_digest

    with lab.store.leases.running([bytes_digest(manifest.content)]):
        collected(lab)
    assert all(lab.store.has(name) for _, name in manifest.objects())


def test_what_a_run_reuses_is_young_again(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    manifest = lab.manifest("data/s")
    lab.run("scale data/r -o data/s --factor 3")
    age(lab)
    for _, name in manifest.objects():
        assert lab.store.keep(name)
    collected(lab)
    assert all(lab.store.has(name) for _, name in manifest.objects())
    assert not lab.store.keep("0" * 64)


def test_recordings_that_nothing_names_are_kept_unless_asked_for(lab: Lab) -> None:
    Path("src").mkdir()
    Path("src/a.txt").write_text("1 2 3")
    lab.run("ingest numbers src -o data/r")
    (name,) = (shard["digest"] for shard in lab.manifest("data/r").recordings["a"]["shards"].values())
    Path("src/a.txt").write_text("4 5 6")
    lab.run("ingest numbers src -o data/r")
    age(lab)
    assert collected(lab)["kept_recordings"] == 1 and lab.store.has(name)
    assert collected(lab, "--recordings")["objects"] >= 1 and not lab.store.has(name)


def test_a_root_that_cannot_be_reached_counts_for_fourteen_days(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data/s").rename("elsewhere")
    age(lab)
    assert collected(lab)["objects"] == 0
    root = lab.store.get_root(lab.folder / "data/s")
    assert root is not None and "missing_since_s" in root
    root["missing_since_s"] -= 13 * 86400
    lab.store.root_path(lab.folder / "data/s").write_text(json.dumps(root))
    assert collected(lab)["objects"] == 0
    root["missing_since_s"] -= 2 * 86400
    lab.store.root_path(lab.folder / "data/s").write_text(json.dumps(root))
    assert collected(lab)["objects"] > 0


def test_the_fourteen_days_begin_anew_when_a_path_was_reached_in_between(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("data/s").rename("elsewhere")
    age(lab)
    collected(lab)
    file = lab.store.root_path(lab.folder / "data/s")
    root = json.loads(file.read_text())
    file.write_text(json.dumps({**root, "missing_since_s": root["missing_since_s"] - 20 * 86400}))
    Path("elsewhere").rename("data/s")
    collected(lab)
    assert "missing_since_s" not in json.loads(file.read_text())
    Path("data/s").rename("elsewhere")
    assert collected(lab)["objects"] == 0


def test_what_git_brought_back_to_a_path_is_live_though_the_root_names_another(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s --factor 2")
    old = Path("data/s/manifest.json").read_bytes()
    lab.run("scale data/r -o data/s --factor 3")
    Path("data/s/manifest.json").write_bytes(old)
    age(lab)
    collected(lab)
    assert tacpipe.open("data/s").to_numpy()["trial-001"][1].tolist() == [4]
    assert upkeep.verify(lab.store).clean


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
            collected(lab, "--recordings --grace-days 0")
        for path in Path("data").glob("*/manifest.json"):
            for _, name in lab.manifest(str(path.parent)).objects():
                lab.store.read(name)


def test_two_collections_do_not_run_at_once(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tacpipe.leases._try_lock", lambda path: None)
        failed = lab.call("store gc")
    assert failed.code == 6
