"""Test contacts and slips of constructed, simulated and, where they are at hand, published recordings."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import columns
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins.params import from_json, to_json
from tacpipe.plugins.registry import load
from tests.conftest import sample_data
from tests.fake_recordings import decode_few_rows_at_a_time

SAMPLE = sample_data()
segment = load("segment.contacts")
slips = load("segment.slips")
synchronize = load("synchronize")
Recording = Callable[..., Any]


def contacts(params: Any, recording: Any) -> pa.Table:
    """Return the table of a segmented recording."""
    return segment(params, recording).streams[""]


def table(loads: list[float], sensor: str = "xela1", rest: float = 1000.0) -> pa.Table:
    """Return two taxels at 50 Hz, pressed by so many counts along z."""
    values = {"t_ns": pa.array(np.arange(len(loads)) * 20_000_000)}
    fields = [pa.field("t_ns", pa.int64())]
    for taxel in (1, 2):
        for axis in "xyz":
            name = f"{sensor}_taxel{taxel:02d}_{axis}"
            values[name] = pa.array(rest + taxel + np.array(loads) * (axis == "z"), pa.float32())
            metadata = {"quantity": "tactile", "stream": sensor, "taxel": str(taxel), "axis": axis, "unit": "count"}
            fields.append(pa.field(name, pa.float32(), metadata=metadata))
    return pa.table(values, schema=pa.schema(fields))


def test_contacts_with_their_padding_are_numbered_and_all_rows_stay(shard: Recording) -> None:
    synced = table([0.0] * 50 + [500.0] * 50 + [0.0] * 100 + [500.0] * 50 + [0.0] * 50)
    labelled = contacts(segment.params(pad_s=0.1), shard({"": synced}))
    assert labelled.column("contact").to_pylist() == [-1] * 45 + [0] * 60 + [-1] * 90 + [1] * 60 + [-1] * 45
    assert labelled.schema.field("contact").type == pa.int32()
    assert labelled.drop_columns(["contact"]).equals(synced)


@pytest.mark.parametrize("rows", [1, 7, 40, 299])
@pytest.mark.parametrize("options", [{}, {"thresholds": "noise"}, {"rest": "lowest", "thresholds": "noise"}])
def test_contacts_and_slips_are_the_same_wherever_blocks_of_rows_end(
    shard: Recording, monkeypatch: pytest.MonkeyPatch, rows: int, options: dict[str, Any]
) -> None:
    chance = np.random.default_rng(rows)
    stored = table((np.repeat([0.0, 500.0, 0.0], 100) + chance.normal(0, 3, 300)).tolist())
    for name in stored.column_names[1:3]:  # repeated samples, and readings that are not finite
        values = stored[name].to_numpy().copy()
        values[20:22], values[150] = values[19], np.nan
        place = stored.column_names.index(name)
        stored = stored.set_column(place, stored.schema.field(name), pa.array(values))
    distance = pa.field("mm", pa.float32(), metadata={"quantity": "proximity", "unit": "mm"})
    stored = stored.append_column(distance, pa.array(np.cumsum(chance.normal(0, 0.2, 300)), pa.float32()))
    params = segment.params(**options)
    at_once = segment(params, shard({"": stored}))
    slipped = slips(slips.params(), shard({"": at_once.streams[""]}))
    decode_few_rows_at_a_time(monkeypatch, rows)
    monkeypatch.setattr(columns, "SOME_ROWS", rows)
    parts = segment(params, shard({"": stored}))
    assert to_parquet(parts.streams[""].read_all()) == to_parquet(at_once.streams[""])
    assert (parts.attributes, parts.notes) == (at_once.attributes, at_once.notes)
    slipped_parts = slips(slips.params(), shard({"": at_once.streams[""]}))
    assert to_parquet(slipped_parts.read_all()) == to_parquet(slipped)


def test_the_level_at_rest_is_written_beside_each_channel(shard: Recording) -> None:
    labelled = contacts(segment.params(), shard({"": table([0.0] * 50 + [500.0] * 50)}))
    assert float(labelled.schema.field("xela1_taxel02_z").metadata[b"rest"]) == 1002.0
    assert labelled.schema.field("xela1_taxel02_z").metadata[b"unit"] == b"count"


def test_the_tare_chooses_the_level_that_is_written_and_never_the_contacts(shard: Recording) -> None:
    recording = shard({"": table([7.0, *[0.0] * 49, *[500.0] * 50])})  # the first frame is a bad one
    labelled_by_tare = {
        tare: contacts(segment.params(tare=tare), recording) for tare in ("median", "first", "axis_mean")
    }
    levels = {
        tare: [
            float(labelled.schema.field(f"xela1_taxel{taxel:02d}_{axis}").metadata[b"rest"])
            for taxel in (1, 2)
            for axis in "xz"
        ]
        for tare, labelled in labelled_by_tare.items()
    }
    assert levels["median"] == [1001.0, 1001.0, 1002.0, 1002.0]
    assert levels["first"] == [1001.0, 1008.0, 1002.0, 1009.0]
    assert levels["axis_mean"] == [0.0, 0.0, 1.0, 1.0]  # less the whole part of 1001.5 and of 1008.5
    for labelled in labelled_by_tare.values():
        assert labelled.column("contact").equals(labelled_by_tare["median"].column("contact"))


def test_either_finger_counts(shard: Recording) -> None:
    resting, pressed = table([0.0] * 100), table([0.0] * 50 + [500.0] * 50, "xela2")
    combined = resting
    for field in pressed.schema:
        if field.name != "t_ns":
            combined = combined.append_column(field, pressed.column(field.name))
    assert (
        contacts(segment.params(pad_s=0.0), shard({"": combined})).column("contact").to_pylist() == [-1] * 50 + [0] * 50
    )


def test_a_recording_without_contact_has_none_in_any_row(shard: Recording) -> None:
    labelled = contacts(segment.params(), shard({"": table([0.0, 50.0] * 50)}))
    assert labelled.column("contact").to_pylist() == [-1] * 100
    assert labelled.column_names == [*table([0.0]).column_names, "contact"]


def test_a_recording_that_begins_in_the_grasp_is_one_contact(shard: Recording) -> None:
    labelled = contacts(segment.params(begins="grasped"), shard({"": table([0.0] * 30)}))
    assert labelled.column("contact").to_pylist() == [0] * 30


def test_what_cannot_be_is_refused(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match="quantity tactile"):
        contacts(segment.params(), shard({"": pa.table({"t_ns": [1]})}))


UNITS = [("N", 0.004), ("mT", 0.0003), ("kPa", 0.05), ("1", 1 / 65535), ("V", 1e-4)]


def in_unit(synced: pa.Table, unit: str, factor: float) -> pa.Table:
    """Return a recording whose tactile channels are in another unit of so much a count."""
    for index, field in enumerate(synced.schema):
        if (field.metadata or {}).get(b"quantity") == b"tactile":
            values = pa.array(synced.column(field.name).to_numpy().astype(np.float64) * factor)
            converted_field = pa.field(field.name, pa.float64(), metadata={**field.metadata, b"unit": unit.encode()})
            synced = synced.set_column(index, converted_field, values)
    return synced


def overlap(labelled: pa.Table, reference: pa.Table) -> float:
    """Return intersection over union of the rows in contact."""
    first, second = (segmented.column("contact").to_numpy() >= 0 for segmented in (labelled, reference))
    return float((first & second).sum() / max((first | second).sum(), 1))


@pytest.mark.parametrize(("unit", "factor"), UNITS)
def test_contacts_of_simulated_trials_in_any_unit_are_those_in_counts_and_of_the_ground_truth(
    unit: str, factor: float, shard: Recording
) -> None:
    simulate = load("simulate.forward")
    for trial in range(4):
        recording = simulate(simulate.params(duration_s=6.0), trial)
        synced = synchronize(synchronize.params(rate_hz=50.0), shard(recording.streams)).streams[""]
        params = segment.params(pad_s=0.0)
        counted, converted = (
            contacts(params, shard({"": source})) for source in (synced, in_unit(synced, unit, factor))
        )
        assert converted.column("contact").unique().to_pylist() == counted.column("contact").unique().to_pylist()
        assert overlap(counted, converted) > 0.98
        pressed = pa.table({"contact": np.where(synced.column("gt_finger1_normal_n").to_numpy() > 0, 0, -1)})
        assert overlap(pressed, converted) > 0.95


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_flat_pick_move").is_dir(), reason="published recordings are not here")
def test_contacts_of_published_trials_in_newtons_are_those_in_counts(shard: Recording) -> None:
    ingest, overlaps = load("ingest.xela-flat"), []
    assert ingest.source is not None
    trials = ingest.source.discover(ingest.params(), SAMPLE / "xela_flat_pick_move")
    for files in list(trials.values())[::4]:
        synced = synchronize(synchronize.params(rate_hz=50.0), shard(ingest(ingest.params(), files).streams)).streams[
            ""
        ]
        in_counts, in_newtons = (
            contacts(segment.params(), shard({"": source})) for source in (synced, in_unit(synced, "N", 0.004))
        )
        overlaps.append(overlap(in_counts, in_newtons))
    assert len(overlaps) == 13 and min(overlaps) > 0.9 and np.median(overlaps) > 0.99


def test_thresholds_in_another_unit_stand_in_the_attributes_and_those_in_counts_do_not(shard: Recording) -> None:
    loads = [*np.random.default_rng(0).normal(0, 1, 50), *[500.0] * 50]
    counted, in_newtons = table(loads), in_unit(table(loads, "skin"), "N", 0.01)
    combined = pa.table(
        {
            **{name: counted[name] for name in counted.column_names},
            **{name: in_newtons[name] for name in in_newtons.column_names},
        }
    ).cast(pa.schema([*counted.schema, *list(in_newtons.schema)[1:]]))
    output = segment(segment.params(pad_s=0.0), shard({"": combined}))
    assert set(output.attributes) == {"skin_contact_on", "skin_contact_off", "skin_contact_unit"}
    assert output.attributes["skin_contact_unit"] == "N" and 0.1 < output.attributes["skin_contact_on"] < 2.5
    assert output.streams[""].column("contact").to_pylist() == [-1] * 50 + [0] * 50
    assert segment(segment.params(), shard({"": counted})).attributes == {} and output.notes == []


def test_thresholds_can_be_given_in_the_unit_of_the_stream(shard: Recording) -> None:
    recording = shard({"": in_unit(table([0.0] * 50 + [50.0] * 50 + [500.0] * 50), "N", 0.01)})
    output = segment(segment.params(on_level=1.0, pad_s=0.0), recording)
    assert output.streams[""].column("contact").to_pylist() == [-1] * 100 + [0] * 50
    assert output.attributes["xela1_contact_on"] == 1.0
    assert output.attributes["xela1_contact_off"] == pytest.approx(2 / 3)
    with_off_level = segment(segment.params(on_level=0.2, off_level=0.1, pad_s=0.0), recording)
    assert with_off_level.streams[""].column("contact").to_pylist() == [-1] * 50 + [0] * 100
    assert with_off_level.attributes["xela1_contact_off"] == 0.1


def test_thresholds_in_a_unit_that_no_stream_has_are_refused(shard: Recording) -> None:
    counted, in_newtons = shard({"": table([0.0])}), shard({"": in_unit(table([0.0]), "N", 0.01)})
    with pytest.raises(UsageError, match=r"on_level and off_level are of streams in other units.*xela1 in count"):
        segment(segment.params(on_level=0.5), counted)
    with pytest.raises(UsageError, match=r"on_count and off_count are of streams in counts.*xela1 in N"):
        segment(segment.params(on_count=50.0, off_count=20.0), in_newtons)
    with pytest.raises(UsageError, match="on_level is 0; it must be above 0"):
        segment(segment.params(on_level=0.0), in_newtons)


def test_a_recording_without_contact_has_a_note_with_thresholds_and_largest_load_in_the_unit(shard: Recording) -> None:
    quiet = table([0.0, 50.0] * 50)
    (note,) = segment(segment.params(), shard({"": quiet})).notes
    assert "no contact of 0.3 s or more was found in this recording" in note
    assert note.endswith("If it was touched in the first 0.2 s, give --rest lowest.")
    assert "xela1 starts contact at a load of 120 count and reaches 50 count. " in note
    assert "--on-count" in note and "--thresholds noise" in note
    (note,) = segment(segment.params(on_level=1.0), shard({"": in_unit(quiet, "N", 0.01)})).notes
    assert "xela1 starts contact at a load of 1 N and reaches 0.5 N. " in note and "lower --on-level." in note
    (note,) = segment(segment.params(), shard({"": in_unit(table([0.0] * 50), "N", 0.01)})).notes
    assert "xela1 never leaves its level at rest" in note
    assert segment(segment.params(begins="grasped"), shard({"": quiet})).notes == []
    assert segment(segment.params(), shard({"": table([0.0] * 50 + [500.0] * 50)})).notes == []


def test_levels_in_other_units_are_part_of_a_key_only_where_they_are_given() -> None:
    assert "on_level" not in to_json(segment.params()) and "off_level" not in to_json(segment.params(on_level=0.5))
    assert to_json(segment.params(on_level=0.5))["on_level"] == 0.5
    assert from_json(segment, to_json(segment.params(on_level=0.5))) == segment.params(on_level=0.5)


def touch(labelled: pa.Table) -> np.ndarray:
    """Return the stamps of the rows in contact."""
    return np.asarray(labelled.column("t_ns").to_numpy()[labelled.column("contact").to_numpy() >= 0])


def test_the_contact_of_a_simulated_trial_is_that_of_its_ground_truth(shard: Recording) -> None:
    simulate = load("simulate.forward")
    for trial in range(4):
        recording = simulate(simulate.params(duration_s=6.0, friction_scale=4.0), trial)
        synced = synchronize(synchronize.params(rate_hz=50.0), shard(recording.streams)).streams[""]
        labelled = contacts(segment.params(pad_s=0.0), shard({"": synced}))
        pressed = synced.column("gt_finger1_normal_n").to_numpy() > 0
        first = synced.column("t_ns").to_numpy()[pressed.argmax()]
        assert labelled.column("contact").unique().to_pylist() == [-1, 0]
        assert 0 <= touch(labelled)[0] - first < 0.2e9
        assert touch(labelled)[-1] == synced.column("t_ns")[-1].as_py()


def looked_at(distance: np.ndarray, contact: np.ndarray | None = None) -> pa.Table:
    """Return what a proximity sensor reads at 50 Hz, and where there is contact."""
    fields = [
        pa.field("t_ns", pa.int64()),
        pa.field("proximity_distance", pa.float32(), metadata={"quantity": "proximity", "unit": "count"}),
    ]
    readings = pa.table([np.arange(len(distance)) * 20_000_000, distance.astype(np.float32)], schema=pa.schema(fields))
    return readings if contact is None else readings.append_column("contact", pa.array(contact.astype(np.int32)))


def fall(rows: int, at: int, lasts: int, count: float) -> np.ndarray:
    """Return readings that fall by ``count`` within ``lasts`` rows."""
    return 740.0 - count * np.clip((np.arange(rows) - at) / lasts, 0.0, 1.0)


def marked(labelled: pa.Table, name: str) -> list[int]:
    rows: list[int] = np.flatnonzero(labelled.column(name).to_numpy()).tolist()
    return rows


def near(marked_rows: list[int], *expected: range) -> bool:
    """Return whether rows are those expected, give or take one at each end: a corner lies between two rows."""
    inner = {row for span in expected for row in span[1:-1]}
    outer = {row for span in expected for row in range(span.start - 1, span.stop + 1)}
    return inner <= set(marked_rows) <= outer


def test_a_slip_is_marked_where_the_object_moves_and_known_a_little_later(shard: Recording) -> None:
    labelled = slips(slips.params(), shard({"": looked_at(fall(300, 150, 30, 120.0))}))
    assert near(marked(labelled, "slip"), range(150, 181))
    assert 151 < marked(labelled, "slip_online")[0] <= 156
    assert marked(labelled, "dropped") == []
    for name in ("slip", "slip_online", "dropped"):
        assert labelled.schema.field(name).type == pa.int8()
        assert labelled.schema.field(name).metadata == {b"unit": b"1", b"quantity": b"label"}


def test_an_object_that_slips_off_the_patch_is_dropped_and_slips_no_more(shard: Recording) -> None:
    labelled = slips(slips.params(saturated_count=0.0), shard({"": looked_at(fall(300, 150, 60, 300.0))}))
    assert marked(labelled, "dropped") == list(range(191, 300))  # beyond 200 counts, which are 25 mm
    assert near(marked(labelled, "slip"), range(150, 191))
    saturated = slips(slips.params(), shard({"": looked_at(np.maximum(fall(300, 150, 60, 300.0), 544.0))}))
    assert marked(saturated, "dropped") == list(range(190, 300))  # 196 counts
    nearer = slips(slips.params(patch_mm=5.0), shard({"": looked_at(fall(300, 150, 60, 300.0))}))
    assert marked(nearer, "dropped")[0] == 159


def test_outside_of_contacts_nothing_slips_and_each_grasp_begins_anew(shard: Recording) -> None:
    first, second = fall(300, 150, 30, 300.0), fall(300, 150, 30, 120.0)
    contact = np.r_[np.full(50, -1), np.zeros(200), np.full(50, -1), np.ones(300)]
    labelled = slips(slips.params(), shard({"": looked_at(np.r_[first, second], contact)}))
    assert marked(labelled, "dropped") == list(range(170, 300))
    assert near(marked(labelled, "slip"), range(150, 170), range(450, 481))
    untouched = slips(slips.params(), shard({"": looked_at(first, np.full(300, -1))}))
    assert marked(untouched, "slip") == marked(untouched, "slip_online") == marked(untouched, "dropped") == []


def test_rows_without_a_reading_do_not_slip(shard: Recording) -> None:
    distance = fall(300, 150, 30, 120.0)
    distance[160:165] = np.nan
    labelled = slips(slips.params(), shard({"": looked_at(distance)}))
    assert near(marked(labelled, "slip"), range(150, 160), range(165, 181))
    assert not set(marked(labelled, "slip")) & set(range(160, 165))


def test_the_online_labels_of_a_recording_do_not_change_with_what_comes_after(shard: Recording) -> None:
    rng = np.random.default_rng(0)
    distance = fall(300, 150, 30, 120.0) + rng.normal(0, 0.4, 300)
    changed = np.r_[distance[:170], 600 + rng.normal(0, 30, 130)]
    labels, changed_labels = (
        slips(slips.params(), shard({"": looked_at(distances)})).column("slip_online").to_pylist()
        for distances in (distance, changed)
    )
    assert labels[:170] == changed_labels[:170]
    assert any(labels[:170])


def test_recordings_in_which_slip_cannot_be_told_are_refused(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match="quantity proximity"):
        slips(slips.params(), shard({"": table([0.0] * 9)}))
    with pytest.raises(TacpipeError, match="no column depth; proximity is in proximity_distance"):
        slips(slips.params(channel="depth"), shard({"": looked_at(np.ones(9))}))
    uneven = looked_at(np.ones(9)).take([0, 1, 2, 5, 6])
    with pytest.raises(TacpipeError, match=r"rows 20 to 60 ms apart.*--rate-hz"):
        slips(slips.params(), shard({"": uneven}))
    with pytest.raises(TacpipeError, match="has 1 rows"):
        slips(slips.params(), shard({"": uneven.slice(0, 1)}))
    with pytest.raises(TacpipeError, match="has a column slip already"):
        slips(slips.params(), shard({"": slips(slips.params(), shard({"": looked_at(np.ones(50))}))}))
    with pytest.raises(TacpipeError, match="end threshold"):
        slips(slips.params(on_sigma=1.0), shard({"": looked_at(np.ones(9))}))


@pytest.mark.long
@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_flat_pick_move").is_dir(), reason="the published recordings are not here")
def test_each_published_trial_has_one_contact_that_begins_before_the_lift(shard: Recording) -> None:
    ingest = load("ingest.xela-flat")
    assert ingest.source is not None
    for files in ingest.source.discover(ingest.params(), SAMPLE / "xela_flat_pick_move").values():
        recording = ingest(ingest.params(), files)
        synced = synchronize(synchronize.params(rate_hz=50.0), shard(recording.streams)).streams[""]
        labelled = contacts(segment.params(), shard({"": synced}))
        height = synced.column("robot_position_z_m").to_numpy()
        lifted = synced.column("t_ns").to_numpy()[(height > height[0] + 0.02).argmax()]
        assert set(labelled.column("contact").unique().to_pylist()) <= {-1, 0}
        assert labelled.num_rows == synced.num_rows
        assert touch(labelled)[0] < lifted
        ends = touch(labelled)[-1] == synced.column("t_ns")[-1].as_py()
        assert ends or recording.attributes["dropped"]


def test_contacts_of_selected_streams_are_those_of_a_recording_with_these_streams_only(shard: Recording) -> None:
    first, second = table([0.0] * 50 + [500.0] * 50), table([0.0] * 20 + [500.0] * 80, "xela2")
    combined = first
    for name in second.column_names[1:]:
        combined = combined.append_column(second.schema.field(name), second.column(name))
    recording = shard({"": combined})
    second_only = contacts(segment.params(), shard({"": second}))
    assert contacts(segment.params(on_count=600.0), recording).num_columns == 14
    assert contacts(segment.params(streams="xela2"), recording).equals(second_only)
    assert contacts(segment.params(without="xela1"), recording).equals(second_only)
