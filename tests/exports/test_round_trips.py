"""What was exported and ingested again has the same shards, by digest, and the same labels."""

import pyarrow as pa
import pytest

import tacpipe
from tacpipe.channels import schema
from tacpipe.formats.lerobot import container
from tacpipe.io import row_groups
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import decode_few_rows_at_a_time, write_dataset

FORMATS = pytest.mark.parametrize(
    ("export", "ingest"),
    [
        ("csv rec", "table out --layout out/layout.toml"),
        ("mcap rec", "mcap out"),
        pytest.param("hdf5 rec", "hdf5 out", marks=pytest.mark.long),
        pytest.param("lerobot rec --rate-hz 100", "lerobot out", marks=pytest.mark.long),
    ],
    ids=["csv", "mcap", "hdf5", "lerobot"],
)


@FORMATS
def test_the_shards_are_the_same(rig: Lab, export: str, ingest: str) -> None:
    assert_same(rig, export, ingest)


@FORMATS
def test_the_shards_are_the_same_when_few_rows_are_read_at_a_time(
    rig: Lab, monkeypatch: pytest.MonkeyPatch, export: str, ingest: str
) -> None:
    decode_few_rows_at_a_time(monkeypatch, 7)
    monkeypatch.setattr(container, "SOME_ROWS", 7)
    monkeypatch.setattr(row_groups, "IN_MEMORY", 0)
    assert_same(rig, export, ingest)


def assert_same(rig: Lab, export: str, ingest: str) -> None:
    rig.run(f"export {export} -o out")
    rig.run(f"ingest {ingest} -o back")
    provided, back = tacpipe.open("rec"), tacpipe.open("back")
    assert {entry.name: entry.digests for entry in back} == {entry.name: entry.digests for entry in provided}
    assert {entry.name: dict(entry.attributes) for entry in back} == {
        entry.name: dict(entry.attributes) for entry in provided
    }


@pytest.mark.long
@pytest.mark.parametrize("export", ["zarr rec --rate-hz 100", "hdf5 rec --structure robomimic --rate-hz 100"])
def test_frames_come_back_with_their_values_and_times(rig: Lab, export: str) -> None:
    rig.run(f"export {export} -o out")
    rig.run("synchronize rec -o sync --rate-hz 100")
    rig.run(f"ingest {'zarr' if 'zarr' in export else 'hdf5'} out -o back")
    for provided, back in zip(tacpipe.open("sync"), tacpipe.open("back"), strict=True):
        tables = [back.table(stream) for stream in back.streams]
        for name in ("skin_taxel01_x", "arm_position_z_m", "skin_gap"):
            (table,) = (table for table in tables if name in table.column_names)
            assert table["t_ns"].equals(provided.table()["t_ns"])
            assert table[name].equals(provided.table()[name])


@pytest.mark.long
def test_events_come_back(lab: Lab) -> None:
    columns = {"stream": pa.array(["skin"]), "cause": pa.array(["link"]), "frames": pa.array([3])}
    fields = [schema.time_field(), *(pa.field(name, column.type) for name, column in columns.items())]
    events = pa.table([pa.array([recordings.START_NS]), *columns.values()], pa.schema(fields))
    write_dataset(lab.folder / "rec", {"a": ({"events": events, "skin": recordings.skin(1)}, {"object": "cup"})})
    for export, ingest in (("mcap rec", "mcap"), ("hdf5 rec", "hdf5"), ("lerobot rec --rate-hz 100", "lerobot")):
        lab.run(f"export {export} -o out-{ingest}")
        lab.run(f"ingest {ingest} out-{ingest} -o back-{ingest}")
        assert tacpipe.open(f"back-{ingest}")["a"].digests == tacpipe.open("rec")["a"].digests
