"""Test that `segment blocks` cuts recordings into blocks that are recordings."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.fake_recordings import FakeRecording, FakeShard, dataset
from tests.stage_params import build_params

MS = 1_000_000
FORCE = schema.float_field("force", "N", "force")


def complete(stream: Any) -> pa.Table:
    """Return all rows of a stream of a result, which is a table or a reader."""
    return stream if isinstance(stream, pa.Table) else stream.read_all()


def stream(t_ms: Any, field: pa.Field = FORCE) -> pa.Table:
    return schema.stream(np.asarray(t_ms) * MS, [np.arange(len(t_ms))], [field])


def cut(*recordings: Any, **params: Any) -> dict[str, Any]:
    """Return the blocks of recordings by name, with their tables read."""
    outputs = registry.load("segment.blocks")(build_params("segment.blocks", **params), dataset(*recordings)).recordings
    return {name: ({key: complete(rows) for key, rows in out.streams.items()}, out) for name, out in outputs.items()}


@pytest.mark.parametrize(("rows", "parts"), [(20, 5), (23, 5), (7, 3), (70_000, 2)])
def test_a_synchronized_recording_is_cut_into_blocks_of_equally_many_rows(rows: int, parts: int) -> None:
    table = stream(np.arange(rows))
    blocks = cut(FakeShard("press", table, {"object": "mug"}), parts=parts)
    assert list(blocks) == [f"press-block-{part}" for part in range(1, parts + 1)]
    pieces = [tables[""] for tables, _ in blocks.values()]
    assert pa.concat_tables(pieces).equals(table)
    assert pieces[0].schema.equals(table.schema, check_metadata=True)
    counts = [piece.num_rows for piece in pieces]
    assert max(counts) - min(counts) <= 1
    assert [dict(out.attributes) for _, out in blocks.values()] == [
        {"object": "mug", "recording": "press", "block": part} for part in range(1, parts + 1)
    ]


def test_streams_that_are_not_synchronized_are_cut_at_the_same_times() -> None:
    skin, arm = stream(np.arange(0, 1000, 10)), stream(np.arange(200, 1200, 7))
    plan = stream([3])
    blocks = cut(FakeRecording({"skin": skin, "arm": arm, "plan": plan}, "press"), parts=4)
    for part, (tables, _) in enumerate(blocks.values()):
        edges_ms = np.array([part, part + 1]) * 1195 / 4  # from 0 to the last sample of the arm
        assert tables.pop("plan").equals(plan)
        for table in tables.values():
            t_ms = table.column("t_ns").to_numpy() / MS
            assert (t_ms >= edges_ms[0] - 1e-6).all() and (t_ms <= edges_ms[1]).all()
    assert pa.concat_tables([tables["arm"] for tables, _ in blocks.values()]).equals(arm)
    assert pa.concat_tables([tables["skin"] for tables, _ in blocks.values()]).equals(skin)
    assert all("skin" in tables for tables, _ in blocks.values())


def test_a_stream_that_has_no_rows_in_a_block_is_not_in_it() -> None:
    blocks = cut(FakeRecording({"skin": stream(np.arange(100)), "events": stream([60, 61])}, "press"), parts=2)
    assert [sorted(tables) for tables, _ in blocks.values()] == [["skin"], ["events", "skin"]]


def test_only_selected_streams_are_in_blocks() -> None:
    recording = FakeRecording({"skin": stream(np.arange(100)), "arm": stream(np.arange(100, 200))}, "press")
    blocks = cut(recording, parts=2, without="arm")
    assert [list(tables) for tables, _ in blocks.values()] == [["skin"], ["skin"]]
    assert pa.concat_tables([tables["skin"] for tables, _ in blocks.values()]).equals(recording.tables["skin"])


def test_numbers_of_blocks_have_equally_many_digits() -> None:
    assert list(cut(FakeShard("press", stream(np.arange(12))), parts=11))[:2] == ["press-block-01", "press-block-02"]


def test_a_video_is_cut_only_before_frames_that_need_no_others() -> None:
    key = pa.field("key_frame", pa.bool_())
    for period, is_refused in ((10, False), (3, True)):
        video = stream(np.arange(40)).append_column(key, pa.array(np.arange(40) % period == 0))
        recording = FakeRecording({"gel": video, "skin": stream(np.arange(0, 41))}, "press")
        if is_refused:
            with pytest.raises(TacpipeError, match="video gel would begin with frame 11, which needs earlier frames"):
                cut(recording, parts=4)
        else:
            assert len(cut(recording, parts=4)) == 4


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        (FakeShard("press", stream(np.arange(4))), "has 4 rows, and 5 blocks need at least one each"),
        (FakeShard("press", stream(np.arange(9)), {"block": 3}), "has the label block already"),
        (FakeShard("press", pa.table({"a": np.arange(9)})), "there is no column t_ns"),
        (FakeShard("press", stream([5, 4, 3, 2, 1, 0])), "the times of its rows decrease"),
    ],
)
def test_a_recording_that_cannot_be_cut_is_refused(recording: Any, message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        cut(recording)


def test_the_last_fold_tests_the_last_block_and_the_stages_before_are_known(lab: Lab) -> None:
    lab.run("simulate forward --trials 2 --duration-s 4 --seed 3 -o data/recordings")
    lab.run("synchronize data/recordings -o data/synced")
    lab.run("segment blocks data/synced --parts 3 -o data/blocks")
    lab.run("split data/blocks --scheme leave-one-out --by block --val 0.3 -o data/split")
    table = tacpipe.open(lab.folder / "data/split").recordings["split"].columns().read(["recording", "fold", "role"])
    tested = [row["recording"] for row in table.to_pylist() if row["fold"] == 2 and row["role"] == "test"]
    assert tested == ["trial-000-block-3", "trial-001-block-3"]
    synced, blocks = lab.manifest("data/synced"), lab.manifest("data/blocks")
    assert blocks.chain == synced.chain
    rows = [sum(shard["rows"] for shard in entry["shards"].values()) for entry in synced.recordings.values()]
    assert sum(s["rows"] for entry in blocks.recordings.values() for s in entry["shards"].values()) == sum(rows)
