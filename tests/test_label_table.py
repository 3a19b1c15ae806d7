"""Labels of many recordings from a table: `tacpipe label DATASET --from TABLE`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.conftest import Lab

TABLES = {  # the same labels in each format
    "labels.csv": "recording,material,grit,good\ntrial-000,foam,3,true\ntrial-002,007,4.5,false\n",
    "labels.tsv": "recording\tmaterial\tgrit\tgood\ntrial-000\tfoam\t3\ttrue\ntrial-002\t007\t4.5\tfalse\n",
    "labels.yaml": (
        "trial-000: {material: foam, grit: 3, good: true}\ntrial-002: {material: '007', grit: 4.5, good: false}\n"
    ),
    "labels.json": json.dumps(
        [
            {"recording": "trial-000", "material": "foam", "grit": 3, "good": True},
            {"recording": "trial-002", "material": "007", "grit": 4.5, "good": False},
        ]
    ),
}
WANTED: dict[str, dict[str, Any]] = {
    "trial-000": {"material": "foam", "grit": 3, "good": True},
    "trial-001": {"material": "cork"},
    "trial-002": {"material": "007", "grit": 4.5, "good": False},
}


def labels(lab: Lab) -> dict[str, dict[str, Any]]:
    attributes = {name: dict(entry["attributes"]) for name, entry in lab.manifest("data/r").recordings.items()}
    return {name: {key: values[key] for key in values if key != "trial"} for name, values in attributes.items()}


@pytest.mark.parametrize("name", TABLES)
def test_each_row_labels_its_recording_with_the_types_that_it_has(toys: Lab, name: str) -> None:
    Path(name).write_text(TABLES[name])
    value = toys.run_json(f"label data/r --from {name}")
    assert labels(toys) == WANTED
    assert value["recordings"] == ["trial-000", "trial-002"] and value["without"] == ["trial-001"]
    for recording, expected in WANTED.items():
        assert {key: type(value) for key, value in labels(toys)[recording].items()} == {
            k: type(v) for k, v in expected.items()
        }


def test_a_parquet_table_keeps_its_types_and_an_empty_cell_changes_nothing(toys: Lab) -> None:
    table = pa.table({"recording": ["trial-000", "trial-001"], "material": [None, "foam"], "grams": [1.0, None]})
    pq.write_table(table, "labels.parquet")
    toys.run("label data/r --from labels.parquet")
    read_back = labels(toys)
    assert read_back["trial-000"] == {"material": "cork", "grams": 1.0}
    assert read_back["trial-001"] == {"material": "foam"}


def test_a_changed_row_costs_the_recordings_whose_labels_changed(toys: Lab) -> None:
    Path("labels.csv").write_text(TABLES["labels.csv"])
    toys.run("label data/r --from labels.csv")
    toys.run("named data/r -o data/named")
    Path("labels.csv").write_text(TABLES["labels.csv"].replace("foam", "felt"))
    value = toys.run_json("label data/r --from labels.csv")
    assert value["labels"] == {"trial-000": {"material": "felt"}}
    rerun = toys.run_json("named data/r -o data/named")
    assert (rerun["ran"], rerun["reused"]) == (1, 2)


def test_a_dry_run_prints_each_change_and_makes_none(toys: Lab) -> None:
    Path("labels.csv").write_text(TABLES["labels.csv"])
    before = toys.manifest("data/r").content
    printed = toys.run("label data/r --from labels.csv --dry-run").out
    assert toys.manifest("data/r").content == before
    for part in ("trial-000", "'cork' → 'foam'", "grit none → 3", "trial-001", "2 of 3"):
        assert part in printed


def test_the_key_is_the_column_whose_values_are_names_whatever_it_is_called(toys: Lab) -> None:
    Path("labels.csv").write_text("nr,which,material\n1,trial-001,foam\n")
    assert toys.run_json("label data/r --from labels.csv")["key"] == "which"
    assert labels(toys)["trial-001"]["material"] == "foam"


def test_a_row_may_name_the_label_called_as_the_key_column(toys: Lab) -> None:
    Path("labels.csv").write_text("trial,material\n2,foam\n")
    toys.run("label data/r --from labels.csv")
    assert labels(toys)["trial-002"]["material"] == "foam" and labels(toys)["trial-000"]["material"] == "cork"


@pytest.mark.parametrize(
    ("name", "content", "arguments", "code", "parts"),
    [
        ("a.csv", "recording,m\ntrial-000,1\nodd,2\nodder,3\n", "", 2, ("a.csv", "odd, odder", "--key")),
        ("a.csv", "recording,m\ntrial-000,1\ntrial-000,2\n", "", 2, ("line 3", "trial-000")),
        ("a.csv", "recording,m\n,1\n", "", 1, ("line 2", "recording")),
        ("a.csv", "recording,m\ntrial-000,1,2\n", "", 1, ("line 2", "3 cells")),
        ("a.csv", "mass,m\n1,2\n", "", 2, ("--key", "mass, m")),
        ("a.csv", "recording,m\ntrial-000,1\n", "--key name", 2, ("name", "recording, m")),
        ("a.csv", "recording,m\n", "", 2, ("a.csv", "no row")),
        ("a.csv", "recording,m\ntrial-000,1\n", "--label m=3", 2, ("--label",)),
        ("a.yaml", "trial-000: {m: [1, 2]}\n", "", 1, ("trial-000", "m is [1, 2]")),
        ("a.yaml", "- 3\n", "", 1, ("entry 0",)),
        ("a.yaml", "trial-000: {m: .nan}\n", "", 1, ("m is nan",)),
        ("a.txt", "x", "", 2, ("a.txt", ".parquet")),
        ("a.parquet", "no table", "", 1, ("a.parquet",)),
    ],
)
def test_a_mistake_is_one_sentence_and_no_label_is_changed(
    toys: Lab, name: str, content: str, arguments: str, code: int, parts: tuple[str, ...]
) -> None:
    Path(name).write_text(content)
    before = labels(toys)
    ran = toys.call(f"label data/r --from {name} {arguments}")
    assert ran.code == code and ran.out == "", ran
    assert all(part in ran.err for part in parts), ran.err
    assert labels(toys) == before


@pytest.mark.parametrize("arguments", ["", "--key x", "trial-000 --dry-run --label a=1"])
def test_without_a_table_recordings_must_be_named_and_its_options_are_refused(toys: Lab, arguments: str) -> None:
    ran = toys.call(f"label data/r {arguments}")
    assert ran.code == 2 and "--from" in ran.err
