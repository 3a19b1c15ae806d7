"""Test that `ingest table` restores exported CSV files bit for bit."""

import json

import numpy as np
import pandas as pd
import pyarrow as pa

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset


def test_what_ingest_reads_back_has_the_same_shards_and_labels(rig: Lab) -> None:
    rig.run("export csv rec -o csv")
    rig.run("ingest table csv --layout csv/layout.toml -o back")
    provided, back = tacpipe.open("rec"), tacpipe.open("back")
    assert list(provided.recordings) == list(back.recordings)
    for entry in provided:
        assert dict(back[entry.name].attributes) == dict(entry.attributes)
        for stream in entry.streams:
            table, read = entry.table(stream), back[entry.name].table(stream)
            assert table.schema.equals(read.schema, check_metadata=True)
            for name in table.column_names:
                assert table.column(name).to_numpy().tobytes() == read.column(name).to_numpy().tobytes() or (
                    table.column(name).equals(read.column(name)) and table.schema.field(name).type == pa.string()
                )
        assert back[entry.name].digests == entry.digests


def test_pandas_reads_a_file_with_the_values_that_were_recorded(rig: Lab) -> None:
    rig.run("export csv rec -o csv")
    frame = pd.read_csv("csv/trial-01/skin.csv")
    np.testing.assert_array_equal(frame["t_ns"], recordings.skin(1)["t_ns"].to_numpy())
    np.testing.assert_array_equal(frame["taxel02_z"], recordings.skin(1)["taxel02_z"].to_numpy())


def test_labels_lie_next_to_the_streams_in_their_types(rig: Lab) -> None:
    rig.run("export csv rec -o csv")
    assert json.loads((rig.folder / "csv/trial-01/labels.json").read_bytes()) == recordings.trial(1)[1]


def test_what_is_not_read_back_is_listed_on_the_output_and_in_the_readme(lab: Lab) -> None:
    cloud = pa.table({"x_m": pa.array([0.5], pa.float32())})
    gaps = recordings.skin(1).append_column("n", pa.array([None] * 40, pa.int32()))
    write_dataset(
        lab.folder / "rec", {"a": ({"cloud": cloud, "skin": gaps}, {}), "b": ({"skin": recordings.skin(2)}, {})}
    )
    err = lab.run("export csv rec -o csv").err
    readme = (lab.folder / "csv/README.md").read_text()
    for text in (err, readme):
        lost = [line for line in text.splitlines() if "stream cloud" in line or "column n" in line]
        assert len(lost) == 2
        assert all("1 of 2 recordings: a" in line for line in lost)
