"""Test the command `tacpipe check`: its answer, exit codes, acceptance, and files that are not ingested yet."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.checks.roles import describe
from tests.conftest import Lab, sample_data, write_plugin
from tests.fake_recordings import write_dataset

LAYOUT = """
[streams.skin]
files = "{trial}.csv"
time = { column = "time", unit = "s" }
columns = [{ match = "T{taxel}", quantity = "tactile", unit = "count" }]
"""


def skin(seed: int, rows: int = 200) -> dict[str, pa.Table]:
    rng = np.random.default_rng(seed)
    values = {f"taxel{i}": rng.integers(100, 200, rows) for i in range(4)}
    return {"skin": pa.table({"t_ns": np.arange(rows) * 10_000_000, **values})}


@pytest.fixture
def copied(lab: Lab) -> Lab:
    """A project with a dataset ``data/rec`` in which two recordings are equal, and two labels differ in case."""
    (lab.folder / "data").mkdir()
    write_dataset(
        lab.folder / "data/rec",
        {
            "a": (skin(1), {"object": "cup"}),
            "b": (skin(2), {"object": "Cup"}),
            "c": (skin(1), {"object": "cup"}),
        },
    )
    return lab


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_first_line_is_the_answer_and_the_exit_code_is_1_until_all_are_accepted(copied: Lab) -> None:
    before = files(copied.folder)
    ran = copied.call("check data/rec")
    assert (ran.code, ran.out.splitlines()[0]) == (1, "2 findings in 3 recordings")
    assert "a = c have equal values. (a, c)" in ran.out
    assert "repair: `tacpipe label DATASET c --exclude copy`" in ran.out
    assert files(copied.folder) == before
    first, second = (line.partition(":")[0] for line in ran.out.splitlines()[1::2])
    ran = copied.call(f"check data/rec --accept {first}")
    assert (ran.code, ran.out.splitlines()[0]) == (1, "2 findings in 3 recordings, 1 accepted")
    ran = copied.call(f"check data/rec --accept {second}")
    assert (ran.code, ran.out.splitlines()[0]) == (0, "2 findings in 3 recordings, 2 accepted")
    assert copied.call("check data/rec").code == 0
    assert set(files(copied.folder)) - set(before) == {"data/rec.accepted.json"}
    assert {name: content for name, content in files(copied.folder).items() if name in before} == before
    found = json.loads(copied.call("check data/rec --json").out)
    assert [finding["accepted"] for finding in found["findings"]] == [True, True]


def test_an_accepted_finding_is_that_of_its_data_whatever_their_names(copied: Lab) -> None:
    ids = [finding["id"] for finding in json.loads(copied.call("check data/rec --json").out)["findings"]]
    copied.run(f"check data/rec --accept {ids[0]} --accept {ids[1]}")
    write_dataset(copied.folder / "data/rec", {"x": (skin(1), {"object": "cup"}), "y": (skin(1), {"object": "cup"})})
    assert copied.call("check data/rec").out.startswith("1 finding in 2 recordings, 1 accepted")
    write_dataset(copied.folder / "data/rec", {"x": (skin(3), {"object": "cup"}), "y": (skin(3), {"object": "cup"})})
    assert copied.call("check data/rec").out.startswith("1 finding in 2 recordings\n")


def test_an_identifier_without_finding_is_refused_and_nothing_is_written(copied: Lab) -> None:
    ran = copied.call("check data/rec --accept gap-12345678")
    assert (ran.code, "There is no finding gap-12345678; there are equal-recordings-" in ran.err) == (2, True)
    assert not (copied.folder / "data/rec.accepted.json").exists()


def test_files_are_checked_before_they_are_ingested_and_leave_no_trace(lab: Lab) -> None:
    Path("lab").mkdir()
    Path("layout.toml").write_text(LAYOUT)
    rng = np.random.default_rng(0)
    for name in ("one", "two"):
        rows = [f"{i // 10 / 10},{rng.integers(0, 99)},{rng.integers(0, 99)}" for i in range(200)]
        Path("lab", f"{name}.csv").write_text("\n".join(["time,T1,T2", *rows, ""]))
    Path("lab", "three.csv").write_text("time,T1,T2\n0.0,1,none\n")
    before = files(lab.folder)
    ran = lab.call("check lab --layout layout.toml --json")
    kinds = {finding["kind"] for finding in json.loads(ran.out)["findings"]}
    assert ran.code == 1
    assert "unreadable" in kinds
    assert kinds <= {"unreadable", "resolution"}  # a layout may spread the batches
    assert files(lab.folder) == before


def test_a_dataset_takes_no_layout_and_a_model_has_no_recordings(copied: Lab) -> None:
    assert copied.call("check data/rec --layout layout.toml").code == 2
    assert copied.call("check nowhere").code == 2


def test_a_training_line_names_labels_and_equal_recordings_in_different_roles() -> None:
    attributes = {
        name: {"material": value} for name, value in {"a": "cork", "b": "Cork", "c": "foam", "d": "cork"}.items()
    }
    roles = {"a": "train", "d": "test", "c": "train"}
    assert describe(attributes, ["material"], [["a", "d"], ["b", "c"]], roles) == (
        "'Cork', 'cork' of the label material differ only in case or space; Recordings with equal content have different "
        "roles: a (train) = d (test). `tacpipe check` lists all findings."
    )
    assert describe({"a": {"material": "cork"}}, ["material"], [["a", "b"]], {"a": "train"}) == ""


def test_a_package_adds_a_check(
    copied: Lab, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    from tests.conftest import forget

    folder = tmp_path_factory.mktemp("plugin")
    code = """
from tacpipe.checks.check import Check


class Short(Check):
    sentences = {"few-rows": ("{subject} has few rows.", "record longer")}

    def examine(self, stream):
        if stream.columns.num_rows < 1000:
            self.note("few-rows", stream, value=stream.columns.num_rows)
"""
    write_plugin(folder, "lab_checks", "[tacpipe.checks]\nshort = lab_checks:Short\n", lab_checks=code)
    monkeypatch.syspath_prepend(folder)
    forget()
    assert "skin has few rows. (a, b, c)" in copied.call("check data/rec").out


@pytest.mark.data
def test_the_published_trials_repeat_rows_and_jump(lab: Lab) -> None:
    source = sample_data() / "xela_flat_pick_move"
    if not source.exists():
        pytest.skip("the published trials are not here")
    Path("trials").mkdir()
    for folder in sorted(path.parent for path in source.rglob("xela_sensor1.csv"))[:12]:
        shutil.copytree(folder, Path("trials", folder.name))
    lab.run("ingest xela-flat trials -o rec")
    kinds = [finding["kind"] for finding in json.loads(lab.call("check rec --json").out)["findings"]]
    assert {"repeated-rows", "spikes", "missing-values"} == set(kinds)
