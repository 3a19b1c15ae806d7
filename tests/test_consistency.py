"""Labels and columns that differ between recordings are named by ingest and label."""

import json

import pytest

import tacpipe
from tacpipe.cli.show import _Values
from tacpipe.codecs.codec import check_channels
from tacpipe.datasets.consistency import column_notes, label_notes
from tacpipe.errors import TacpipeError
from tacpipe.io import config_text
from tests.conftest import Lab
from tests.formats.table import labs

LAYOUT = """
[streams.skin]
files = "rec_{rec}/skin.csv"
time = { column = "time" }
columns = [{ match = "taxel{taxel}", quantity = "tactile", unit = "count" }, { match = "fx", quantity = "force" }]

[[labels]]
file = "rec_{rec}/meta.json"
"""
INGEST = "ingest table own --layout layout.toml -o data/rec"


def write_lab(lab: Lab, materials: list[object], missing: dict[int, str]) -> None:
    """Write a recording per material; ``missing`` are the columns that some recordings lack, by index."""
    for number, material in enumerate(materials):
        folder = lab.folder / "own" / f"rec_{number}"
        folder.mkdir(parents=True)
        frame = labs.frame(seed=number)
        frame.drop(columns=[missing[number]] if number in missing else []).to_csv(folder / "skin.csv", index=False)
        (folder / "meta.json").write_text(json.dumps({"material": material}))
    (lab.folder / "layout.toml").write_text(LAYOUT)


def test_labels_and_columns_that_differ_are_noted_also_when_nothing_is_read_again(lab: Lab) -> None:
    write_lab(lab, ["cork", "Cork", "foam", "cork\u00a0"], {1: "taxel3", 3: "taxel3"})
    for _ in range(2):
        printed = lab.call(INGEST).err
        assert "The label material is written in several ways: 'Cork' (1), 'cork' (1), 'cork\\xa0' (1)" in printed
        assert "skin has no taxel3 in 2 of 4 recordings: rec_1, rec_3." in printed
    assert [recording.name for recording in tacpipe.open("data/rec")] == ["rec_0", "rec_1", "rec_2", "rec_3"]
    assert "'FOAM' (1), 'foam' (1)" in lab.call("label data/rec rec_0 --label material=FOAM").err
    assert "foam" not in lab.call("label data/rec rec_0 --label material=foam").err


def test_a_name_in_the_layout_that_some_recordings_lack_is_noted(lab: Lab) -> None:
    write_lab(lab, ["cork", "cork"], {1: "fx"})
    ran = lab.call(INGEST)
    assert ran.code == 0 and "rec_1: skin has no column fx." in ran.err


def test_recordings_that_failed_alike_are_one_line_before_those_that_were_read(lab: Lab) -> None:
    write_lab(lab, ["cork"] * 20, {})
    for number in (3, 12):
        path = lab.folder / "own" / f"rec_{number}" / "skin.csv"
        path.write_text(path.read_text() + "oops,1,2,3,4,5\n")
    ran = lab.call(INGEST)
    lines = ran.err.splitlines()
    assert ran.code == 1 and any("could not read 2 recordings of 20" in line for line in lines)
    assert [line for line in lines if line.startswith("  rec_12, rec_3: ") and "NAME/skin.csv" in line]
    assert sum(line.endswith("read, 50 rows") for line in lines) == 18 and "--skip-bad" in lines[-1]


@pytest.mark.parametrize(
    ("first", "second", "differ"),
    [
        ("cork", "CORK", True),
        ("cork", " cork", True),
        ("caf\u00e9", "cafe\u0301", True),
        (1, "1", True),
        (True, "true", True),
        ("cork", "foam", False),
        (0.5, "0.5", False),
        (None, "none", False),
    ],
)
def test_spellings_of_one_label_are_found(first: str, second: str, differ: bool) -> None:
    assert bool(label_notes({"a": {"label": first}, "b": {"label": second}})) == differ


def test_columns_are_compared_by_stream_and_not_by_order() -> None:
    streams = {"a": {"x": ["t", "u"], "y": ["t"]}, "b": {"x": ["u", "t"]}}
    assert column_notes(streams) == []


def test_text_without_quotes_in_yaml_is_a_number_only_if_it_is_written_as_one() -> None:
    texts = {
        "a": "no",
        "b": "on",
        "c": "010",
        "d": "12:30:45",
        "e": "0x1F",
        "f": "2024-05-01",
        "g": "yes",
        "h": "1_000",
    }
    document = "".join(f"{name}: {text}\n" for name, text in texts.items())
    assert config_text.load_labels(document) == texts
    assert config_text.load_labels("{a: 2, b: 0.5, c: true, d: '2', e: ~, f: &x {g: 1}, h: *x}") == {
        **{"a": 2, "b": 0.5, "c": True, "d": "2", "e": None},
        **{"f": {"g": 1}, "h": {"g": 1}},
    }


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (["cork", 3.5, 2, "cork"], "2 (1), 3.5 (1), cork (2)"),
        ([0.5, 2], "0.5 to 2"),
        ([True, 0.5], "0.5 (1), True (1)"),
        ([None, 0.5], "0.5 (1), None (1)"),
    ],
)
def test_labels_of_mixed_kinds_are_listed(values: list[object], text: str) -> None:
    summary = _Values()
    for value in values:
        summary.add(value)
    assert str(summary) == text


def test_recordings_with_other_columns_are_refused_without_a_codec() -> None:
    with pytest.raises(TacpipeError, match="it lacks s_T3 and it also has s_T9") as error:
        check_channels(["s_T1", "s_T3"], ["s_T1", "s_T9"], is_fitted=False)
    assert "codec" not in str(error.value)
