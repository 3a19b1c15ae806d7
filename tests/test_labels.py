"""`label` and `show` read and write only what they change or list, however many recordings there are."""

import itertools
import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.cli.show import SHOWN
from tacpipe.datasets import intervals
from tests.conftest import FileCalls, Lab

MANY = SHOWN + 10
STREAMS = 2  # Each recording of the toy has this many.


@pytest.fixture
def many_recordings(lab: Lab) -> Lab:
    lab.run(f"simulate toy --trials {MANY} -o data/r --jobs 1")
    return lab


@pytest.mark.inline
def test_show_reads_the_shards_of_the_recordings_that_it_lists(many_recordings: Lab, file_calls: FileCalls) -> None:
    file_calls.clear()
    text = many_recordings.run("show data/r").out
    assert file_calls.take("objects") == SHOWN * STREAMS
    assert text.count("left") == SHOWN
    assert f"… and {MANY - SHOWN} more (--full)" in text
    assert f"{MANY} recordings, {MANY * STREAMS * 20} rows" in text
    assert f"material: cork ({MANY})" in text
    assert many_recordings.run("show data/r --full").out.count("left") == MANY
    assert file_calls.take("objects") == MANY * STREAMS
    assert len(many_recordings.run_json("show data/r")["recordings"]) == MANY


def inodes(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_ino for path in folder.rglob("*.parquet")}


@pytest.mark.inline
def test_a_label_reads_and_writes_no_shard(many_recordings: Lab, file_calls: FileCalls) -> None:
    before = inodes(many_recordings.folder / "data/r")
    assert len(before) == MANY * STREAMS
    file_calls.clear()
    many_recordings.run("label data/r trial-003 --label material=foam")
    shards = {digest for _, digest in many_recordings.manifest("data/r").objects()}
    assert file_calls.take("objects") <= 3  # manifests
    assert inodes(many_recordings.folder / "data/r") == before
    assert all(many_recordings.store.has(digest) for digest in shards)
    assert many_recordings.manifest("data/r").recordings["trial-003"]["attributes"]["material"] == "foam"


def test_a_shard_that_is_gone_when_a_label_is_set_is_brought_back_by_link(many_recordings: Lab) -> None:
    shard = many_recordings.folder / "data/r/trial-000/left.parquet"
    content = shard.read_bytes()
    shard.unlink()
    many_recordings.run("label data/r trial-003 --label material=foam")
    many_recordings.run("store link data/r")
    assert shard.read_bytes() == content


@pytest.mark.parametrize(("trials", "ending"), [(3, "it has trial-000, trial-001, trial-002."), (7, "and 2 more.")])
def test_a_recording_that_is_not_there_is_refused_with_those_that_are(lab: Lab, trials: int, ending: str) -> None:
    lab.run(f"simulate toy --trials {trials} -o data/r --jobs 1")
    failed = lab.call("label data/r nobody --label a=b")
    assert failed.code == 2 and "nobody" in failed.err and failed.err.rstrip().endswith(ending)


def test_a_label_of_several_lines_is_refused_on_one(lab: Lab) -> None:
    lab.run("simulate toy --trials 1 -o data/r --jobs 1")
    failed = lab.call("label data/r trial-000 --label 'a\nb=c'")
    assert failed.code == 2 and failed.err.count("\n") == 1 and "a\\nb=c" in failed.err


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


TIMES = st.tuples(st.integers(0, 1000), st.integers(0, 1000)).map(lambda pair: (min(pair) / 8, max(pair) / 8))


@given(st.lists(TIMES, max_size=6))
def test_a_text_reads_back_as_the_union_of_its_intervals(times: list[tuple[float, float]]) -> None:
    again = intervals.from_text(intervals.to_text(times))
    moments = [eighth / 8 for eighth in range(1001)]

    def covered(parts: list[tuple[float, float]]) -> list[bool]:
        return [any(begin <= moment <= end for begin, end in parts) for moment in moments]

    assert covered(again) == covered(times)
    assert all(first[1] < second[0] for first, second in itertools.pairwise(again))


def row_labels(lab: Lab) -> dict[str, Any]:
    recordings = lab.manifest("data/r").recordings
    return {name: entry["attributes"].get("slip_intervals") for name, entry in recordings.items()}


def test_an_interval_is_added_to_those_of_the_named_recordings(toys: Lab) -> None:
    toys.run("label data/r trial-000 --interval slip 1.5 2")
    toys.run("label data/r 'trial-00[01]' --interval slip 0.25 0.5")
    assert row_labels(toys) == {"trial-000": "0.25-0.5 1.5-2", "trial-001": "0.25-0.5", "trial-002": None}


def test_a_file_replaces_the_intervals_of_the_recordings_that_it_names(toys: Lab) -> None:
    toys.run("label data/r 'trial-*' --interval slip 9 10")
    Path("slips.csv").write_text(
        "recording,interval,from_s,to_s\ntrial-000,slip,1,2\ntrial-000,slip,4,4.5\ntrial-001,slip,,\n"
    )
    toys.run("label data/r --intervals slips.csv")
    assert row_labels(toys) == {"trial-000": "1-2 4-4.5", "trial-001": "", "trial-002": "9-10"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("label data/r trial-000 --interval slip 2 1", "the smaller one first"),
        ("label data/r trial-000 --interval slip nan 1", "the smaller one first"),
        ("label data/r --interval slip 1 2", "Name the recordings to label"),
        ("label data/r trial-000 --interval 'a slip' 1 2", "is not a name for intervals"),
        ("label data/r trial-009 --interval slip 1 2", "has no recording trial-009"),
        ("label data/r --intervals slips.csv --interval slip 1 2", "--intervals names recordings and labels itself"),
        ("label data/r --intervals slips.csv", "and the dataset has no such recording"),
        ("label data/r --intervals bad.csv", "is not an interval. Give seconds as numbers"),
        ("label data/r --intervals heads.csv", "it must have recording, interval, from_s, to_s"),
    ],
)
def test_intervals_that_mean_nothing_are_refused(toys: Lab, words: str, message: str) -> None:
    heads = "recording,interval,from_s,to_s\n"
    Path("slips.csv").write_text(f"{heads}trial-077,slip,1,2\n")
    Path("bad.csv").write_text(f"{heads}trial-000,slip,one,2\n")
    Path("heads.csv").write_text("recording,begin,end\ntrial-000,1,2\n")
    ran = toys.call(words)
    assert ran.code == 2
    assert message in " ".join(ran.err.split())
    assert row_labels(toys) == dict.fromkeys(row_labels(toys))


def test_show_lists_the_intervals_of_a_recording(toys: Lab) -> None:
    toys.run("label data/r trial-000 --interval slip 0.01 0.02")
    spans = toys.run_json("show data/r trial-000")["label_spans"]
    assert [(span["name"], round(span["start_s"], 6), round(span["stop_s"], 6)) for span in spans] == [
        ("slip", 0.01, 0.02)
    ]
