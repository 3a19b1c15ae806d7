"""Test streams on one clock: values, types, masks and refusals."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from tacpipe.channels import schema
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import columns
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins.params import from_json, to_json
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.synchronization import streams as grids
from tests.conftest import sample_data
from tests.fake_recordings import FakeRecording

SAMPLE = sample_data()
T0 = 1_637_771_974_778_354_001
MS = 1_000_000
synchronize, contacts = load("synchronize"), load("segment.contacts")
Recording = Callable[..., Any]
ROWS: dict[str, dict[str, Any]] = {
    "uniform": {"rate_hz": 50.0},
    "logged": {"grid": "logged"},
    "fresh": {"grid": "fresh"},
}


def params(**values: Any) -> Any:
    return synchronize.params(**values)


def interpolated(**values: Any) -> Any:
    """Return params of interpolated rows, at 50 Hz where no rows at the stamps of the master are asked for."""
    return params(**{"values": "interpolate", **({} if "grid" in values else {"rate_hz": 50.0}), **values})


def uskin(t_ms: np.ndarray, values: np.ndarray | None = None) -> pa.Table:
    if values is None:
        values = np.random.default_rng(0).integers(14_000, 46_000, (len(t_ms), 48))
    return schema.stream(T0 + np.asarray(t_ms) * MS, values.T, schema.uskin_fields())


def robot(t_ms: np.ndarray) -> pa.Table:
    turned = Rotation.random(len(t_ms), rng=np.random.default_rng(1)).as_quat()
    pose = np.column_stack([np.sin(t_ms / 100), t_ms, t_ms * 2, turned])
    return schema.stream(T0 + np.asarray(t_ms) * MS, pose.T, schema.pose_fields())


def run(shard: Any, **values: Any) -> tuple[pa.Table, Any]:
    recording = synchronize(interpolated(**values), shard)
    assert isinstance(recording, RecordingOutput)
    return recording.streams[""], recording.attributes


@pytest.mark.parametrize("values", ["hold", "interpolate"])
@pytest.mark.parametrize("rows", [{}, {"rate_hz": 200.0}, {"rate_hz": 2500.0}, {"grid": "fresh"}])
@pytest.mark.parametrize("block_bytes", [1, 20_000])
def test_a_long_recording_that_is_read_in_blocks_gives_the_rows_of_one_block(
    shard: Recording, monkeypatch: pytest.MonkeyPatch, values: str, rows: dict[str, Any], block_bytes: int
) -> None:
    wrapping = ((np.arange(400)[:, None] * 700 + np.arange(48)) % 65_536).astype(np.uint16)
    wrapping[7::3] = wrapping[6:-1:3]
    arm = robot(np.arange(-30, 395))
    components = [arm.column(f"orientation_{part}").to_numpy().copy() for part in "xyzw"]
    for component in components:
        component[100:103] = np.nan  # an unseen marker
        component[200::7] *= -1  # the same rotation
    for part, component in zip("xyzw", components, strict=True):
        place = arm.schema.get_field_index(f"orientation_{part}")
        arm = arm.set_column(place, arm.schema.field(place), pa.array(component))
    readings = np.random.default_rng(3).integers(0, 999, 160)
    near = schema.stream(
        T0 + np.arange(-30, 3970, 25) * (MS // 10),
        [readings],
        [pa.field("near", pa.uint16(), metadata={"quantity": "proximity"})],
    )
    streams = {"robot": arm, "xela1": uskin(np.arange(400), wrapping), "near": near}
    expected = synchronize(params(values=values, **rows), shard(streams))
    module = sys.modules[synchronize.function.__module__]
    monkeypatch.setattr(module, "IN_MEMORY", 1000)
    monkeypatch.setattr(module, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(grids, "POINTS", 19)
    monkeypatch.setattr(columns.Columns.batches, "__defaults__", (None, 13))
    monkeypatch.setattr(columns, "BLOCK_BYTES", 5000)
    parts = synchronize(params(values=values, **rows), shard(streams))
    assert to_parquet(parts.streams[""].read_all()) == to_parquet(expected.streams[""])
    assert (parts.attributes, parts.notes) == (expected.attributes, expected.notes)


def test_the_grid_starts_with_the_first_tactile_stream_and_ends_where_a_stream_does(shard: Recording) -> None:
    table, attributes = run(
        shard(
            {"robot": robot(np.arange(-30, 95)), "xela2": uskin(np.arange(3, 200)), "xela1": uskin(np.arange(0, 150))}
        )
    )
    assert ((table.column("t_ns").to_numpy() - T0) / MS).tolist() == [20.0, 40.0, 60.0, 80.0]
    assert attributes["grid_master"] == "xela1"
    assert attributes["grid_rate_hz"] == 50.0


def test_values_are_those_of_numpy_interp_and_scipy_slerp(shard: Recording) -> None:
    t_ms = np.cumsum(np.random.default_rng(2).integers(1, 30, 40))
    tactile, arm = uskin(t_ms), robot(t_ms)
    table, _ = run(shard({"xela1": tactile, "robot": arm}), rate_hz=120.0)
    grid_ns = table.column("t_ns").to_numpy() - T0
    for name in ("taxel01_x", "taxel16_z"):
        expected = np.interp(grid_ns, t_ms * MS, tactile.column(name).to_numpy().astype(float))
        np.testing.assert_allclose(table.column(f"xela1_{name}").to_numpy(), expected, atol=0.01)
        assert table.schema.field(f"xela1_{name}").type == pa.float32()
    parts = [f"orientation_{part}" for part in "xyzw"]
    turned = Rotation.from_quat(np.column_stack([arm.column(part).to_numpy() for part in parts]))
    rotations = Rotation.from_quat(np.column_stack([table.column(f"robot_{part}").to_numpy() for part in parts]))
    assert (rotations * Slerp(t_ms * MS, turned)(grid_ns).inv()).magnitude().max() < 1e-6
    assert table.schema.field("robot_position_x_m").type == pa.float64()


def test_every_channel_tells_where_it_came_from_and_how(shard: Recording) -> None:
    labels = schema.stream(T0 + np.arange(1, 100, 3) * MS, [np.arange(33) % 2], [schema.label_field("slip")])
    t_ms = np.arange(0, 100, 9)
    table, _ = run(shard({"xela1": uskin(t_ms), "robot": robot(t_ms), "slip": labels}))
    for column, method, quantity in (
        ("xela1_taxel03_y", b"linear", b"tactile"),
        ("robot_orientation_w", b"slerp", b"orientation"),
        ("slip_slip", b"nearest", b"label"),
    ):
        metadata = table.schema.field(column).metadata
        assert (metadata[b"interpolation"], metadata[b"quantity"]) == (method, quantity)
        assert metadata[b"stream"].decode() == column.split("_")[0]
    assert table.schema.field("slip_slip").type == pa.int8()


def test_wide_integers_become_float64_and_device_clocks_stay_integers(shard: Recording) -> None:
    t_ms = np.arange(0, 100, 7)
    table = uskin(t_ms)
    table = table.append_column("wide", pa.array(t_ms * 10**9)).append_column("seq", pa.array(np.arange(len(t_ms))))
    synced, _ = run(shard({"xela1": table}))
    assert synced.schema.field("xela1_wide").type == pa.float64()
    assert synced.schema.field("xela1_seq").type == pa.int64()


def test_holds_gaps_and_distances_are_marked(shard: Recording) -> None:
    t_ms = np.array([0, 20, 41, 60, 140, 160])
    values = np.repeat(np.arange(6)[:, None], 48, axis=1)
    values[2] = values[1]
    table, attributes = run(shard({"xela1": uskin(t_ms, values)}))
    assert table.column("xela1_held").to_pylist() == [False, False, True, *[False] * 6]
    assert table.column("xela1_gap").to_pylist() == [False] * 4 + [True] * 3 + [False] * 2
    assert table.column("xela1_dt_ns").to_pylist() == [0, 0, MS, 0, 20 * MS, 40 * MS, 20 * MS, 0, 0]
    assert attributes["xela1_rate_hz"] == pytest.approx(5 / 0.16)
    assert attributes["xela1_fresh_hz"] == pytest.approx(4 / 0.16)


def test_on_the_logged_grid_values_at_equal_stamps_stay_as_they_are(shard: Recording) -> None:
    t_ms = np.array([0, 10, 10, 25, 60])
    tactile, arm = uskin(t_ms), robot(t_ms[:-1])
    table, _ = run(shard({"xela1": tactile, "robot": arm, "other": robot(np.arange(-5, 70, 2))}), grid="logged")
    assert table.num_rows == 4
    for name in tactile.column_names[1:]:
        channel = table.column(f"xela1_{name}")
        assert channel.type == pa.uint16()
        assert channel.to_pylist() == tactile.column(name).to_pylist()[:4]
    assert table.column("robot_orientation_x").to_pylist() == arm.column("orientation_x").to_pylist()
    assert table.schema.field("robot_orientation_x").metadata[b"interpolation"] == b"none"
    assert table.schema.field("other_orientation_x").metadata[b"interpolation"] == b"slerp"


def test_on_the_fresh_grid_are_the_rows_of_the_master_that_are_not_held(shard: Recording) -> None:
    t_ms = np.array([0, 10, 10, 25, 60, 70])
    values = np.random.default_rng(3).integers(14_000, 46_000, (6, 48))
    values[2], values[4] = values[1], values[3]  # the held row 2 has the stamp of row 1
    first, second = uskin(t_ms, values), uskin(t_ms)
    table, attributes = run(
        shard({"xela1": first, "xela2": second, "robot": robot(np.arange(-5, 90, 2))}), grid="fresh"
    )
    assert ((table.column("t_ns").to_numpy() - T0) / MS).tolist() == [0.0, 10.0, 25.0, 70.0]
    for name in first.column_names[1:]:
        assert table.column(f"xela1_{name}").to_pylist() == first.column(name).take([0, 1, 3, 5]).to_pylist()
        assert table.column(f"xela2_{name}").to_pylist() == second.column(name).take([0, 1, 3, 5]).to_pylist()
        assert table.column(f"xela1_{name}").type == pa.uint16()
    assert not any(table.column("xela1_held").to_pylist())
    assert table.schema.field("robot_orientation_x").metadata[b"interpolation"] == b"slerp"
    assert attributes["grid"] == "fresh"
    assert attributes["grid_rate_hz"] == pytest.approx(3 / 0.07, abs=1e-3)


def with_device(table: pa.Table, t_device_ns: np.ndarray) -> pa.Table:
    """Return a stream with its device's clock and numbers, as drivers log them."""
    kinds = [
        pa.field("t_device_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}),
        pa.field("seq", pa.int64(), metadata={"unit": "1", "quantity": "label"}),
    ]
    table = table.append_column(kinds[0], pa.array(t_device_ns))
    return table.append_column(kinds[1], pa.array(np.arange(table.num_rows)))


def late(seconds: int = 10) -> tuple[pa.Table, np.ndarray]:
    """Return a stream at 100 Hz whose channels are its true time in ms and which comes late, and its device's stamps."""
    taken_ns = np.arange(100 * seconds) * 10 * MS
    arrival_ns = np.maximum.accumulate(
        taken_ns + np.random.default_rng(5).exponential(3 * MS, len(taken_ns)).astype(int)
    )
    table = uskin(taken_ns / MS, np.repeat(taken_ns[:, None] // MS, 48, axis=1))
    return table.set_column(0, table.schema.field("t_ns"), pa.array(T0 + arrival_ns)), (taken_ns * 1.00004).astype(int)


def test_the_jitter_of_arrival_is_taken_away_with_and_without_a_fit_of_the_device_s_clock(shard: Recording) -> None:
    table, device_ns = late()
    streams = {"xela1": with_device(table, device_ns), "robot": robot(np.arange(0, 9000))}
    errors = {}
    for clock in ("auto", "arrival"):
        synced, attributes = run(shard(streams), clock=clock)
        taken_ms = (synced.column("t_ns").to_numpy() - T0) / MS
        errors[clock] = np.abs(synced.column("xela1_taxel01_x").to_numpy() - taken_ms)
        assert ("xela1_clock_drift_ppm" in attributes) == (clock == "auto")
        assert not any("robot_clock" in name for name in attributes)
        assert synced.schema.field("xela1_t_device_ns").type == pa.int64()
        assert set(synced.column("xela1_t_device_ns").to_pylist()) <= set(device_ns.tolist())
        assert set(synced.column("xela1_seq").to_pylist()) <= set(range(1000))
    assert errors["auto"].max() < 0.2
    assert np.median(errors["arrival"]) < 0.1  # estimated while samples come, which needs some seconds to settle


def test_the_fit_of_each_clock_is_an_attribute(shard: Recording) -> None:
    table, device_ns = late()
    _, attributes = run(shard({"xela1": with_device(table, device_ns)}), clock="device")
    assert attributes["xela1_clock_offset_ms"] == pytest.approx(T0 / MS, abs=0.2)
    assert attributes["xela1_clock_drift_ppm"] == pytest.approx(-40, abs=10)
    assert attributes["xela1_clock_residual_ms"] == pytest.approx(3 * np.log(2), rel=0.2)


def test_ground_truth_needs_no_device(shard: Recording) -> None:
    table, device_ns = late()
    truth = schema.stream(T0 + np.arange(9000) * MS, [np.zeros(9000)], [schema.float_field("gt_mass_kg", "kg", "mass")])
    synced, _ = run(shard({"xela1": with_device(table, device_ns), "truth": truth}), clock="device")
    assert "gt_mass_kg" in synced.column_names


def test_a_device_clock_that_is_none_is_named_with_its_stream(shard: Recording) -> None:
    table, device_ns = late()
    with pytest.raises(TacpipeError, match=r"Recording trial, stream 'xela1': .* is constant, 7 ns .*--clock arrival"):
        run(shard({"xela1": with_device(table, np.full(len(device_ns), 7))}))
    with_null = pa.array([None, *device_ns[1:].tolist()], pa.int64())
    with pytest.raises(TacpipeError, match="t_device_ns of stream 'xela1' is int64 with 1 empty rows"):
        run(shard({"xela1": table.append_column("t_device_ns", with_null)}))


def test_proximity_is_the_median_of_the_readings_around_and_lies_between_them_where_there_are_none(
    shard: Recording,
) -> None:
    t_ms = np.r_[np.arange(0, 100, 2.5), np.arange(150, 201, 2.5)]
    counts = np.random.default_rng(0).integers(544, 757, len(t_ms))
    field = pa.field("distance", pa.int16(), metadata={"unit": "count", "quantity": "proximity"})
    near = schema.stream(T0 + (t_ms * MS).astype(int), [counts], [field])
    table, _ = run(shard({"xela1": uskin(np.arange(0, 220, 20)), "proximity": near}))
    expected = []
    for point in np.arange(0, 201, 20):
        around = np.abs(t_ms - point) <= 10
        expected.append(np.median(counts[around]) if around.any() else np.interp(point, t_ms, counts))
    medians = table.column("proximity_distance")
    np.testing.assert_allclose(medians.to_numpy(), expected, rtol=1e-6)
    assert medians.type == pa.float32()
    assert table.schema.field("proximity_distance").metadata[b"interpolation"] == b"median"
    assert table.column("proximity_gap").to_pylist()[6:7] == [True]


def test_a_tactile_channel_that_wraps_is_unwrapped_and_no_other_one_changes(shard: Recording) -> None:
    t_ms = np.arange(0, 200, 10)
    walk = np.full((20, 48), 30_000)
    walk[:, 5] = 65_000 + 100 * np.arange(20)
    tactile = uskin(t_ms, walk % 65_536)
    counter = pa.field("count", pa.uint16(), metadata={"unit": "1", "quantity": "counter"})
    tactile = tactile.append_column(counter, pa.array(walk[:, 5] % 65_536, pa.uint16()))
    wrapping = tactile.column_names[6]
    logged, attributes = run(shard({"xela1": tactile}), grid="logged")
    assert logged.column(f"xela1_{wrapping}").type == pa.int32()
    assert logged.column(f"xela1_{wrapping}").to_pylist() == walk[:, 5].tolist()
    assert attributes["xela1_wrapped_channels"] == 1
    other_names = [name for name in tactile.column_names[1:] if name != wrapping]
    assert all(logged.column(f"xela1_{name}").equals(tactile.column(name)) for name in other_names)
    uniform, _ = run(shard({"xela1": tactile}), rate_hz=200.0)
    assert uniform.column(f"xela1_{wrapping}").type == pa.float32()
    np.testing.assert_array_equal(uniform.column(f"xela1_{wrapping}").to_numpy(), 65_000 + 50 * np.arange(39))
    not_unwrapped, attributes = run(shard({"xela1": tactile}), grid="logged", unwrap=False)
    assert not_unwrapped.column(f"xela1_{wrapping}").equals(tactile.column(wrapping))
    assert "xela1_wrapped_channels" not in attributes


@pytest.mark.long
@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_flat_pick_move").is_dir(), reason="the published recordings are not here")
def test_nothing_wraps_in_the_published_trials(shard: Recording) -> None:
    ingest = load("ingest.xela-flat")
    assert ingest.source is not None
    for files in ingest.source.discover(ingest.params(), SAMPLE / "xela_flat_pick_move").values():
        recording = ingest(ingest.params(), files)
        logged, attributes = run(shard(recording.streams), grid="logged")
        assert not any("wrapped" in name for name in attributes)
        assert {logged.schema.field(name).type for name in logged.column_names if "_taxel" in name} == {pa.uint16()}


def test_ground_truth_keeps_its_names_and_has_no_masks(shard: Recording) -> None:
    t_ms = np.arange(0, 200)
    truth = schema.stream(T0 + t_ms * MS, [t_ms / 2], [schema.float_field("gt_force_n", "N", "force")])
    table, attributes = run(shard({"xela1": uskin(t_ms), "truth": truth, "events": truth.slice(0, 0)}))
    assert table.column("gt_force_n").to_pylist() == [k * 10.0 for k in range(10)]
    assert not any("truth" in name or "events" in name for name in [*table.column_names, *attributes])


def test_an_unseen_marker_stays_unseen(shard: Recording) -> None:
    t_ms = np.arange(0, 100, 20)
    pose = np.repeat([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], 5, axis=0)
    pose[2] = np.nan
    marker = schema.stream(T0 + t_ms * MS, pose.T, schema.pose_fields())
    table, _ = run(shard({"xela1": uskin(t_ms), "marker": marker}), rate_hz=100.0)
    for column in ("marker_position_x_m", "marker_orientation_w"):
        assert np.isnan(table.column(column).to_numpy()).tolist() == [False] * 3 + [True] * 3 + [False] * 3


def test_time_that_runs_backwards_is_named_with_stream_and_row(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match=r"Recording trial: the time of stream 'robot' runs backwards at row 2"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.array([0, 5, 4]))}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"clock": "device"}, "stream 'robot' has no column t_device_ns"),
        ({"master": "camera"}, "no stream 'camera'; --master must be one of robot, xela1"),
        ({"rate_hz": 0.0}, "must be above 0 and at most 1e9"),
    ],
)
def test_params_that_cannot_be_are_refused(shard: Recording, values: dict[str, Any], message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(9))}), **values)


def test_streams_without_common_time_rows_or_touch_are_refused(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match="within the time range of all streams"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(20, 30))}))
    with pytest.raises(TacpipeError, match="stream 'robot' has no rows"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(0))}))
    with pytest.raises(TacpipeError, match="quantity tactile"):
        run(shard({"robot": robot(np.arange(9))}))


def test_half_a_quaternion_is_refused(shard: Recording) -> None:
    t_ms = np.arange(0, 100, 7)
    with pytest.raises(TacpipeError, match="needs x, y, z and w once each"):
        run(shard({"xela1": uskin(t_ms), "robot": robot(t_ms).drop_columns(["orientation_w"])}))


def test_images_text_and_single_rows_neither_bound_the_grid_nor_stand_on_it(shard: Recording) -> None:
    t_ns = np.arange(100) * 10_000_000
    skin = pa.table({"t_ns": t_ns, "a": pa.array(np.arange(100), pa.int32())})
    camera = pa.table({"t_ns": t_ns[:3], "data": pa.array([b"x"] * 3, pa.binary()), "width": pa.array([1] * 3)})
    note = pa.table({"t_ns": t_ns[5:6], "data": ["hello"]})
    fixed_pose = pa.table({"t_ns": t_ns[:1], "position_x_m": [0.5]})
    streams = {"skin": skin, "camera": camera, "note": note, "still": fixed_pose}
    table, attributes = run(shard(streams), master="skin", rate_hz=100.0)
    assert table.column_names == ["t_ns", "skin_a", "skin_held", "skin_gap", "skin_dt_ns"]
    assert table.num_rows == 100
    assert attributes["not_synchronized"] == "camera, note, still"


def test_held_rows_hold_the_newest_sample_that_had_come_and_its_age(shard: Recording) -> None:
    t_ms = np.cumsum(np.random.default_rng(3).integers(5, 40, 40))
    tactile, arm = uskin(t_ms), robot(np.arange(3, 700, 7))
    table, attributes = run(shard({"xela1": tactile, "robot": arm}), values="hold", rate_hz=50.0)
    grid_ms = (table.column("t_ns").to_numpy() - T0) / MS
    assert grid_ms[-1] > min(t_ms[-1], 696) - 20 and attributes["grid"] == "uniform"
    for stream, recorded, name in (("xela1", tactile, "taxel05_y"), ("robot", arm, "orientation_z")):
        stamps = (recorded.column("t_ns").to_numpy() - T0) / MS
        rows = [int(np.flatnonzero(stamps <= point)[-1]) for point in grid_ms]
        column = table.column(f"{stream}_{name}")
        assert column.to_numpy().tolist() == recorded.column(name).to_numpy()[rows].tolist()
        assert (column.type, table.schema.field(f"{stream}_{name}").metadata[b"interpolation"]) == (
            recorded.schema.field(name).type,
            b"hold",
        )
        age_ms = grid_ms - stamps[rows]
        assert (table.column(f"{stream}_dt_ns").to_numpy() / MS).tolist() == age_ms.tolist()
        assert table.column(f"{stream}_gap").to_pylist() == (age_ms > 50).tolist()


@pytest.mark.parametrize("kind", ROWS)
@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 999), until_ms=st.integers(150, 1400))
def test_rows_of_held_values_do_not_depend_on_what_comes_later(kind: str, seed: int, until_ms: int) -> None:
    """Check that cut recordings have the rows before the cut of the whole ones, also with their contacts marked."""
    rng = np.random.default_rng(seed)
    t_ms = np.cumsum(rng.integers(5, 40, 60))
    near = schema.stream(
        T0 + np.arange(0, 1500, 2) * MS, [rng.normal(size=750)], [schema.float_field("near_m", "m", "proximity")]
    )
    arm = with_device(robot(np.arange(3, 1500, 7)), T0 + np.cumsum(rng.integers(5, 9, 214)) * MS)
    streams = {"xela1": uskin(t_ms, rng.integers(0, 65_536, (60, 48))), "robot": arm, "n": near}
    cut = {
        name: stream.filter(pa.array(stream["t_ns"].to_numpy() <= T0 + until_ms * MS))
        for name, stream in streams.items()
    }
    if not cut["xela1"].num_rows:
        return
    hold_params = params(gap_ms=50.0, **ROWS[kind])  # the default gap depends on the rate of the whole recording
    uncut, part = (synchronize(hold_params, FakeRecording(tables)) for tables in (streams, cut))
    rows = part.streams[""].num_rows
    assert rows and part.streams[""].to_pydict() == uncut.streams[""].slice(0, rows).to_pydict()
    last_ns = cut["xela1"]["t_ns"].to_numpy()[-1]
    assert uncut.streams[""]["t_ns"].to_numpy()[rows:].min(initial=2 * T0) > last_ns
    assert uncut.attributes["look_ahead_max_ms"] == 0.0
    levels = []
    for output in (part, uncut):
        segmented = contacts(contacts.params(rest_s=0.0), FakeRecording({"": output.streams[""]})).streams[""]
        levels.append([(segmented.schema.field(name).metadata or {}).get(b"rest") for name in segmented.column_names])
    assert levels[0] == levels[1]


def test_the_look_ahead_of_interpolated_rows_is_the_time_to_the_next_sample_or_its_arrival(shard: Recording) -> None:
    tactile, arm = uskin(np.arange(0, 2000, 20)), robot(np.arange(-4, 1990, 26))
    table, attributes = run(shard({"xela1": tactile, "robot": arm}), grid="logged")
    arm_ms = (arm["t_ns"].to_numpy() - T0) / MS
    ahead_ms = [min(arm_ms[arm_ms >= at]) - at for at in (table["t_ns"].to_numpy() - T0) / MS]
    assert attributes["look_ahead_mean_ms"] == pytest.approx(np.mean(ahead_ms), abs=1e-3)
    assert attributes["look_ahead_max_ms"] == max(ahead_ms) and attributes["step_ms"] == 20.0
    repeated = synchronize(params(), FakeRecording({"xela1": tactile, "robot": arm}))
    assert repeated.attributes["look_ahead_max_ms"] == 0.0 and repeated.attributes["grid"] == "logged"
    assert repeated.streams[""]["robot_position_x_m"].type == pa.float64()


@pytest.mark.parametrize(
    ("stored", "values"),
    [
        ({"grid": "uniform", "rate_hz": 25.0}, {"rate_hz": 25.0, "values": "interpolate"}),
        ({"grid": "logged", "rate_hz": 50.0}, {"values": "interpolate"}),
        ({"grid": "fresh", "rate_hz": 50.0, "causal": True}, {"grid": "fresh"}),
        ({"grid": "uniform", "rate_hz": 50.0, "causal": True}, {"rate_hz": 50.0}),
    ],
)
def test_params_of_before_held_values_are_read_as_what_they_did(stored: dict[str, Any], values: dict[str, Any]) -> None:
    assert from_json(synchronize, {**stored, "master": "", "gap_ms": 50.0}) == params(**values, gap_ms=50.0)
    assert to_json(params())["values"] == "hold"


def test_held_rows_have_the_clock_of_arrival_and_refuse_that_of_the_device() -> None:
    with pytest.raises(UsageError, match="arrival"):
        params(clock="device").check()


def test_what_a_live_session_records_of_itself_is_no_signal(shard: Recording) -> None:
    t_ms = np.arange(0, 500, 20)
    streams = {"xela1": uskin(t_ms)}
    for quantity in ("plan", "prediction", "latency", "alarm"):
        field = schema.float_field("value", "1", quantity)
        streams[quantity] = schema.stream(T0 + t_ms[:9] * MS, [np.zeros(9)], [field])
    table, attributes = run(shard(streams))
    assert attributes["not_synchronized"] == "alarm, latency, plan, prediction"
    assert table.num_rows == len(t_ms)


@pytest.mark.parametrize(("period_ms", "gap_ms"), [(20, 50.0), (50, 50.0), (73, 182.5)])
def test_without_a_gap_a_slow_stream_may_pause_for_two_and_a_half_periods(
    shard: Recording, period_ms: int, gap_ms: float
) -> None:
    t_ms = np.arange(0, 4000, period_ms)
    t_ms = t_ms[(t_ms < 2000) | (t_ms > 3000)]  # a gap whichever the period
    recording = shard({"xela1": uskin(t_ms)})
    table, attributes = run(recording)
    spelled_out, _ = run(recording, gap_ms=gap_ms)
    assert attributes["xela1_gap_ms"] == gap_ms
    assert table.equals(spelled_out)
    grid_ms = (table["t_ns"].to_numpy() - T0) / MS
    before, after = t_ms[t_ms < 2000][-1], t_ms[t_ms > 3000][0]
    assert table["xela1_gap"].to_pylist() == ((grid_ms > before) & (grid_ms < after)).tolist()


def test_a_stream_with_many_rows_in_gaps_is_named_and_others_are_not(shard: Recording) -> None:
    slow, fast = uskin(np.arange(0, 4000, 73)), robot(np.arange(0, 4000, 10))
    recording = shard({"xela1": slow, "robot": fast})
    assert not synchronize(interpolated(), recording).notes
    (note,) = synchronize(interpolated(gap_ms=50.0), recording).notes
    assert "stream xela1" in note and "--gap-ms" in note


def test_streams_without_a_common_time_are_named_with_dates_and_can_be_left_out(shard: Recording) -> None:
    early, late = robot(np.arange(0, 100)), robot(np.arange(300, 400))
    recording = shard({"xela1": uskin(np.arange(0, 200)), "early": early, "late": late})
    with pytest.raises(TacpipeError) as raised:
        run(recording)
    message = str(raised.value)
    assert "late starts last, at 2021-11-24 16:39:35.078 UTC" in message
    assert "early ends first, at 2021-11-24 16:39:34.877 UTC" in message and "--without" in message
    without_late, _ = run(shard({"xela1": uskin(np.arange(0, 200)), "early": early}))
    for values in ({"without": "late"}, {"streams": "xela1, early"}, {"streams": "*1,e*", "without": "l*"}):
        assert run(recording, **values)[0].equals(without_late)


def test_a_stream_that_is_selected_and_does_not_exist_is_refused_with_a_near_name(shard: Recording) -> None:
    recording = shard({"xela1": uskin(np.arange(0, 200)), "robot": robot(np.arange(0, 100))})
    with pytest.raises(TacpipeError, match=r"no stream 'rob0t', which --without names; it has .*Did you mean robot"):
        run(recording, without="rob0t")
    with pytest.raises(TacpipeError, match="no stream left"):
        run(recording, without="*")
