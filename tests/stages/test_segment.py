"""Contacts and slips of synchronized recordings: made up, simulated, and published where they are at hand."""

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
slips = load("segment.slips")
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


def test_contacts_with_their_padding_are_numbered_and_all_rows_stay(shard: Shard) -> None:
    given = table([0.0] * 50 + [500.0] * 50 + [0.0] * 100 + [500.0] * 50 + [0.0] * 50)
    found = contacts(contacts.params(pad_s=0.1), shard({"": given}))
    assert found.column("contact").to_pylist() == [-1] * 45 + [0] * 60 + [-1] * 90 + [1] * 60 + [-1] * 45
    assert found.schema.field("contact").type == pa.int32()
    assert found.drop_columns(["contact"]).equals(given)


def test_the_level_at_rest_is_written_beside_each_channel(shard: Shard) -> None:
    found = contacts(contacts.params(), shard({"": table([0.0] * 50 + [500.0] * 50)}))
    assert float(found.schema.field("xela1_taxel02_z").metadata[b"rest"]) == 1002.0
    assert found.schema.field("xela1_taxel02_z").metadata[b"unit"] == b"count"


def test_the_tare_chooses_the_level_that_is_written_and_never_the_contacts(shard: Shard) -> None:
    given = shard({"": table([7.0, *[0.0] * 49, *[500.0] * 50])})  # the first frame is a bad one
    found = {tare: contacts(contacts.params(tare=tare), given) for tare in ("median", "first", "axis_mean")}
    levels = {
        tare: [
            float(one.schema.field(f"xela1_taxel{taxel:02d}_{axis}").metadata[b"rest"])
            for taxel in (1, 2)
            for axis in "xz"
        ]
        for tare, one in found.items()
    }
    assert levels["median"] == [1001.0, 1001.0, 1002.0, 1002.0]
    assert levels["first"] == [1001.0, 1008.0, 1002.0, 1009.0]
    assert levels["axis_mean"] == [0.0, 0.0, 1.0, 1.0]  # less the whole part of 1001.5 and of 1008.5
    for one in found.values():
        assert one.column("contact").equals(found["median"].column("contact"))


def test_either_finger_counts(shard: Shard) -> None:
    still, pressed = table([0.0] * 100), table([0.0] * 50 + [500.0] * 50, "xela2")
    both = still
    for field in pressed.schema:
        if field.name != "t_ns":
            both = both.append_column(field, pressed.column(field.name))
    assert contacts(contacts.params(pad_s=0.0), shard({"": both})).column("contact").to_pylist() == [-1] * 50 + [0] * 50


def test_a_recording_without_contact_has_none_in_any_row(shard: Shard) -> None:
    found = contacts(contacts.params(), shard({"": table([0.0, 50.0] * 50)}))
    assert found.column("contact").to_pylist() == [-1] * 100
    assert found.column_names == [*table([0.0]).column_names, "contact"]


def test_a_recording_that_begins_in_the_grasp_is_one_contact(shard: Shard) -> None:
    found = contacts(contacts.params(begins="grasped"), shard({"": table([0.0] * 30)}))
    assert found.column("contact").to_pylist() == [0] * 30


def test_what_cannot_be_is_refused(shard: Shard) -> None:
    with pytest.raises(TacpipeError, match="has no tactile channel"):
        contacts(contacts.params(), shard({"": pa.table({"t_ns": [1]})}))


def touched(found: pa.Table) -> np.ndarray:
    """Return the stamps of the rows in contact."""
    return np.asarray(found.column("t_ns").to_numpy()[found.column("contact").to_numpy() >= 0])


def test_the_contact_of_a_simulated_trial_is_that_of_its_ground_truth(shard: Shard) -> None:
    simulate = load("simulate.forward")
    for trial in range(4):
        recording = simulate(simulate.params(duration_s=6.0, friction_scale=4.0), trial)
        synced = synchronize(synchronize.params(), shard(recording.streams)).streams[""]
        found = contacts(contacts.params(pad_s=0.0), shard({"": synced}))
        pressed = synced.column("gt_finger1_normal_n").to_numpy() > 0
        first = synced.column("t_ns").to_numpy()[pressed.argmax()]
        assert found.column("contact").unique().to_pylist() == [-1, 0]
        assert 0 <= touched(found)[0] - first < 0.2e9
        assert touched(found)[-1] == synced.column("t_ns")[-1].as_py()


def looked_at(distance: np.ndarray, contact: np.ndarray | None = None) -> pa.Table:
    """Return what a proximity sensor reads at 50 Hz, and where there is contact."""
    fields = [
        pa.field("t_ns", pa.int64()),
        pa.field("proximity_distance", pa.float32(), metadata={"quantity": "proximity", "unit": "count"}),
    ]
    found = pa.table([np.arange(len(distance)) * 20_000_000, distance.astype(np.float32)], schema=pa.schema(fields))
    return found if contact is None else found.append_column("contact", pa.array(contact.astype(np.int32)))


def fall(rows: int, at: int, lasts: int, count: float) -> np.ndarray:
    """Return readings that fall by ``count`` within ``lasts`` rows."""
    return 740.0 - count * np.clip((np.arange(rows) - at) / lasts, 0.0, 1.0)


def marked(found: pa.Table, name: str) -> list[int]:
    rows: list[int] = np.flatnonzero(found.column(name).to_numpy()).tolist()
    return rows


def near(found: list[int], *wanted: range) -> bool:
    """Return whether rows are those wanted, give or take one at each end: a corner lies between two rows."""
    inner = {row for one in wanted for row in one[1:-1]}
    outer = {row for one in wanted for row in range(one.start - 1, one.stop + 1)}
    return inner <= set(found) <= outer


def test_a_slip_is_marked_where_the_object_moves_and_known_a_little_later(shard: Shard) -> None:
    found = slips(slips.params(), shard({"": looked_at(fall(300, 150, 30, 120.0))}))
    assert near(marked(found, "slip"), range(150, 181))
    assert 151 < marked(found, "slip_online")[0] <= 156
    assert marked(found, "dropped") == []
    for name in ("slip", "slip_online", "dropped"):
        assert found.schema.field(name).type == pa.int8()
        assert found.schema.field(name).metadata == {b"unit": b"1", b"quantity": b"label"}


def test_an_object_that_slips_off_the_patch_is_dropped_and_slips_no_more(shard: Shard) -> None:
    found = slips(slips.params(saturated_count=0.0), shard({"": looked_at(fall(300, 150, 60, 300.0))}))
    assert marked(found, "dropped") == list(range(191, 300))  # beyond 200 counts, which are 25 mm
    assert near(marked(found, "slip"), range(150, 191))
    saturated = slips(slips.params(), shard({"": looked_at(np.maximum(fall(300, 150, 60, 300.0), 544.0))}))
    assert marked(saturated, "dropped") == list(range(190, 300))  # 196 counts
    nearer = slips(slips.params(patch_mm=5.0), shard({"": looked_at(fall(300, 150, 60, 300.0))}))
    assert marked(nearer, "dropped")[0] == 159


def test_outside_of_contacts_nothing_slips_and_each_grasp_begins_anew(shard: Shard) -> None:
    first, second = fall(300, 150, 30, 300.0), fall(300, 150, 30, 120.0)
    contact = np.r_[np.full(50, -1), np.zeros(200), np.full(50, -1), np.ones(300)]
    found = slips(slips.params(), shard({"": looked_at(np.r_[first, second], contact)}))
    assert marked(found, "dropped") == list(range(170, 300))
    assert near(marked(found, "slip"), range(150, 170), range(450, 481))
    none = slips(slips.params(), shard({"": looked_at(first, np.full(300, -1))}))
    assert marked(none, "slip") == marked(none, "slip_online") == marked(none, "dropped") == []


def test_rows_without_a_reading_do_not_slip(shard: Shard) -> None:
    distance = fall(300, 150, 30, 120.0)
    distance[160:165] = np.nan
    found = slips(slips.params(), shard({"": looked_at(distance)}))
    assert near(marked(found, "slip"), range(150, 160), range(165, 181))
    assert not set(marked(found, "slip")) & set(range(160, 165))


def test_the_online_labels_of_a_recording_do_not_change_with_what_comes_after(shard: Shard) -> None:
    rng = np.random.default_rng(0)
    distance = fall(300, 150, 30, 120.0) + rng.normal(0, 0.4, 300)
    other = np.r_[distance[:170], 600 + rng.normal(0, 30, 130)]
    now, then = (
        slips(slips.params(), shard({"": looked_at(one)})).column("slip_online").to_pylist()
        for one in (distance, other)
    )
    assert now[:170] == then[:170]
    assert any(now[:170])


def test_recordings_in_which_slip_cannot_be_told_are_refused(shard: Shard) -> None:
    with pytest.raises(TacpipeError, match="has 0 columns whose quantity is proximity"):
        slips(slips.params(), shard({"": table([0.0] * 9)}))
    with pytest.raises(TacpipeError, match="no column depth; proximity is in proximity_distance"):
        slips(slips.params(channel="depth"), shard({"": looked_at(np.ones(9))}))
    uneven = looked_at(np.ones(9)).take([0, 1, 2, 5, 6])
    with pytest.raises(TacpipeError, match=r"rows 20 to 60 ms apart.*--grid uniform"):
        slips(slips.params(), shard({"": uneven}))
    with pytest.raises(TacpipeError, match="has 1 rows"):
        slips(slips.params(), shard({"": uneven.slice(0, 1)}))
    with pytest.raises(TacpipeError, match="has a column slip already"):
        slips(slips.params(), shard({"": slips(slips.params(), shard({"": looked_at(np.ones(50))}))}))
    with pytest.raises(TacpipeError, match="flickers"):
        slips(slips.params(on_sigma=1.0), shard({"": looked_at(np.ones(9))}))


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
        assert set(found.column("contact").unique().to_pylist()) <= {-1, 0}
        assert found.num_rows == synced.num_rows
        assert touched(found)[0] < lifted
        ends = touched(found)[-1] == synced.column("t_ns")[-1].as_py()
        assert ends or recording.attributes["dropped"]
