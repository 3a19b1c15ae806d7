"""Contacts of synchronized recordings: made up, simulated, and published where they are at hand."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.registry import load

SAMPLE = Path(os.environ.get("TACPIPE_SAMPLE_DATA", Path(__file__).parents[3] / "shared" / "data"))
contacts = load("segment.contacts")
synchronize = load("synchronize")
Shard = Callable[..., Any]


def table(loads: list[float], sensor: str = "xela1", rest: float = 1000.0) -> pa.Table:
    """Two taxels at 50 Hz, pressed by so many counts along z."""
    values = {"t_ns": pa.array(np.arange(len(loads)) * 20_000_000)}
    fields = [pa.field("t_ns", pa.int64())]
    for taxel in (1, 2):
        for axis in "xyz":
            name = f"{sensor}_taxel{taxel:02d}_{axis}"
            values[name] = pa.array(rest + taxel + np.array(loads) * (axis == "z"), pa.float32())
            metadata = {"quantity": "tactile", "stream": sensor, "taxel": str(taxel), "axis": axis, "unit": "count"}
            fields.append(pa.field(name, pa.float32(), metadata=metadata))
    return pa.table(values, schema=pa.schema(fields))


def test_only_contact_with_its_padding_is_kept_and_numbered(shard: Shard) -> None:
    loads = [0.0] * 50 + [500.0] * 50 + [0.0] * 100 + [500.0] * 50 + [0.0] * 50
    found = contacts(contacts.params(pad_s=0.1), shard({"": table(loads)}))
    rows = found.column("t_ns").to_numpy() // 20_000_000
    assert rows.tolist() == [*range(45, 105), *range(195, 255)]
    assert found.column("contact").to_pylist() == [0] * 60 + [1] * 60
    assert found.schema.field("contact").type == pa.int32()


def test_the_level_at_rest_is_written_beside_each_channel(shard: Shard) -> None:
    found = contacts(contacts.params(), shard({"": table([0.0] * 50 + [500.0] * 50)}))
    assert float(found.schema.field("xela1_taxel02_z").metadata[b"rest"]) == 1002.0
    assert found.schema.field("xela1_taxel02_z").metadata[b"unit"] == b"count"


def test_either_finger_counts(shard: Shard) -> None:
    still, pressed = table([0.0] * 100), table([0.0] * 50 + [500.0] * 50, "xela2")
    both = still
    for field in pressed.schema:
        if field.name != "t_ns":
            both = both.append_column(field, pressed.column(field.name))
    assert contacts(contacts.params(pad_s=0.0), shard({"": both})).num_rows == 50


def test_a_recording_without_contact_gives_no_rows_and_all_columns(shard: Shard) -> None:
    found = contacts(contacts.params(), shard({"": table([0.0, 50.0] * 50)}))
    assert found.num_rows == 0
    assert found.column_names == [*table([0.0]).column_names, "contact"]


def test_a_recording_that_begins_in_the_grasp_is_one_contact(shard: Shard) -> None:
    found = contacts(contacts.params(begins="grasped"), shard({"": table([0.0] * 30)}))
    assert found.column("contact").to_pylist() == [0] * 30


def test_what_cannot_be_is_refused(shard: Shard) -> None:
    with pytest.raises(TacpipeError, match="begins is 'maybe'"):
        contacts(contacts.params(begins="maybe"), shard({"": table([0.0])}))
    with pytest.raises(TacpipeError, match="has no tactile channel"):
        contacts(contacts.params(), shard({"": pa.table({"t_ns": [1]})}))


def test_the_contact_of_a_simulated_trial_is_that_of_its_ground_truth(shard: Shard) -> None:
    simulate = load("simulate.forward")
    for trial in range(4):
        recording = simulate(simulate.params(duration_s=6.0), trial)
        synced = synchronize(synchronize.params(), shard(recording.streams)).streams[""]
        found = contacts(contacts.params(pad_s=0.0), shard({"": synced}))
        pressed = synced.column("gt_finger1_normal_n").to_numpy() > 0
        first = synced.column("t_ns").to_numpy()[pressed.argmax()]
        assert found.column("contact").unique().to_pylist() == [0]
        assert 0 <= found.column("t_ns")[0].as_py() - first < 0.2e9
        assert found.column("t_ns")[-1] == synced.column("t_ns")[-1]


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_flat_pick_move").is_dir(), reason="the published recordings are not here")
def test_each_published_trial_has_one_contact_that_begins_before_the_lift(shard: Shard) -> None:
    ingest = load("ingest.xela-flat")
    assert ingest.discover is not None
    for files in ingest.discover(ingest.params(), SAMPLE / "xela_flat_pick_move").values():
        recording = ingest(ingest.params(), files)
        synced = synchronize(synchronize.params(), shard(recording.streams)).streams[""]
        found = contacts(contacts.params(), shard({"": synced}))
        height = synced.column("robot_position_z_m").to_numpy()
        lifted = synced.column("t_ns").to_numpy()[(height > height[0] + 0.02).argmax()]
        assert found.column("contact").unique().to_pylist() == [0]
        assert found.column("t_ns")[0].as_py() < lifted
        ends = found.column("t_ns")[-1] == synced.column("t_ns")[-1]
        assert ends or recording.attributes["dropped"]
