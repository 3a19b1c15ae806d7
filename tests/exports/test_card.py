"""Dataset cards: DuckDB and polars read the rows; `datasets` and `mlcroissant` read them in `test_other_tools`."""

import json
from typing import Any

import duckdb
import polars as pl
import yaml

from tests.conftest import Lab
from tests.exports import recordings


def rows(query: str) -> list[Any]:
    """Return what DuckDB answers."""
    answer = duckdb.sql(query)
    assert answer is not None
    return answer.fetchall()


def test_duckdb_and_polars_read_the_rows_with_their_recording_and_types(rig: Lab) -> None:
    rig.run("export card rec -o card --license cc-by-4.0")
    result = rows(
        "select recording, object, max(seq) from 'card/data/skin/*.parquet' join 'card/labels.parquet' using (recording) "
        "group by all order by 1"
    )
    assert result == [("trial-00", "box", 39), ("trial-01", "cup", 39)]
    frame = pl.read_parquet("card/data/odd/*.parquet").filter(pl.col("recording") == "trial-01").drop("recording")
    assert frame.to_arrow().cast(recordings.odd(1).schema).equals(recordings.odd(1))
    assert frame.schema["uint32"] == pl.UInt32


def test_a_dataset_directory_opens_in_duckdb_and_polars_as_it_is(rig: Lab) -> None:
    assert pl.read_parquet("rec/*/skin.parquet").height == 80
    assert rows("select count(*) from 'rec/*/skin.parquet'") == [(80,)]


def test_the_card_has_a_configuration_a_stream_and_the_licence(rig: Lab) -> None:
    rig.run("export card rec -o card --license cc-by-4.0 --title 'Our: touch'")
    text = (rig.folder / "card/README.md").read_text()
    front = yaml.safe_load(text.split("---")[1])
    assert front["license"] == "cc-by-4.0"
    assert front["pretty_name"] == "Our: touch"
    assert {entry["config_name"]: entry["data_files"] for entry in front["configs"]} == {
        "arm": "data/arm/*.parquet",
        "odd": "data/odd/*.parquet",
        "skin": "data/skin/*.parquet",
        "labels": "labels.parquet",
    }
    assert "| skin | 2 | 80 |" in text
    assert "6 tactile (count)" in text


def test_croissant_states_the_type_and_unit_of_each_column(rig: Lab) -> None:
    rig.run("export card rec -o card --license cc-by-4.0 --creators 'A, B'")
    value = json.loads((rig.folder / "card/croissant.json").read_bytes())
    fields = {field["@id"]: field for records in value["recordSet"] for field in records["field"]}
    assert fields["skin/taxel01_x"]["dataType"] == "sc:Integer"
    assert "tactile (count)" in fields["skin/taxel01_x"]["description"]
    assert fields["odd/said"]["dataType"] == "sc:Text"
    assert all(" " not in name for name in fields)
    assert fields["odd/on"]["dataType"] == "sc:Boolean"
    assert [entry["name"] for entry in value["creator"]] == ["A", "B"]


def test_a_licence_that_is_not_stated_is_a_note(rig: Lab) -> None:
    assert "--license" in rig.run("export card rec -o card").err
    assert "license" not in json.loads((rig.folder / "card/croissant.json").read_bytes())
