"""Measured truth: interpolated at the times of rows, without a say in them, and an input of no stage."""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import arm, schema, streams
from tacpipe.channels.schema import TRUTH_KEY, is_truth
from tacpipe.checks.check import Stream
from tacpipe.codecs import tactile
from tacpipe.datasets.arrays import is_channel
from tacpipe.errors import UsageError
from tacpipe.io import columns
from tacpipe.plugins.params import to_json
from tacpipe.plugins.registry import load
from tacpipe.plugins.rows import RowCounts
from tacpipe.synchronization import streams as grids
from tacpipe.synchronization.truth import truth_columns
from tacpipe.tasks.material import slides
from tests.fake_recordings import FakeRecording, FakeShard

T0 = 1_637_771_974_778_354_001
MS = 1_000_000
synchronize = load("synchronize")
SKIN_MS = np.arange(0, 400, 10)
FORCE_MS = np.arange(33, 303, 9)  # starts later and ends earlier than the skin
FORCE_N = np.sin(FORCE_MS / 50.0) * 20


def skin(t_ms: np.ndarray = SKIN_MS) -> pa.Table:
    counts = np.random.default_rng(0).integers(14_000, 46_000, (len(t_ms), 48))
    return schema.stream(T0 + t_ms * MS, counts.T, schema.uskin_fields())


def sensor(t_ms: np.ndarray = FORCE_MS, **values: Any) -> pa.Table:
    """Return a stream with one column per argument: values and field."""
    return schema.stream(
        T0 + t_ms * MS, [column for column, _ in values.values()], [kind for _, kind in values.values()]
    )


def force(t_ms: np.ndarray = FORCE_MS, newtons: np.ndarray = FORCE_N) -> pa.Table:
    return sensor(t_ms, force=(newtons, schema.float_field("force_z", "N", "force", "z")))


def run(tables: Mapping[str, pa.Table], truth: str = "ft_*", **values: Any) -> Any:
    return synchronize(synchronize.params(truth=truth, **values), FakeRecording(tables))


def rows_and_values(output: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    table = output.streams[""]
    return (table.column("t_ns").to_numpy() - T0) / MS, table.column(name).to_numpy()


def within(t_ms: np.ndarray, samples_ms: np.ndarray = FORCE_MS) -> np.ndarray:
    return np.asarray((t_ms >= samples_ms[0]) & (t_ms <= samples_ms[-1]))


@pytest.mark.parametrize("values", [{}, {"values": "interpolate"}, {"rate_hz": 70.0}, {"grid": "fresh"}])
def test_truth_is_interpolated_at_the_times_of_the_rows_whatever_values_is(values: dict[str, Any]) -> None:
    t_ms, newtons = rows_and_values(run({"skin": skin(), "ft": force()}, **values), "ft_force_z")
    assert t_ms[0] == 0 and t_ms[-1] >= 380  # the force does not decide where rows begin and end
    expected = np.where(within(t_ms), np.interp(t_ms, FORCE_MS, FORCE_N), np.nan)
    np.testing.assert_allclose(newtons, expected, atol=1e-9)


def test_a_gap_longer_than_the_limit_has_no_truth_and_its_rows_stay() -> None:
    sparse_ms = FORCE_MS[(FORCE_MS < 100) | (FORCE_MS > 200)]
    tables = {"skin": skin(), "ft": force(sparse_ms, sparse_ms * 1.0)}
    for gap_ms, missing in ((None, True), (150.0, False)):
        output = run(tables, gap_ms=gap_ms)
        t_ms, newtons = rows_and_values(output, "ft_force_z")
        in_gap = (t_ms > sparse_ms[sparse_ms < 100][-1]) & (t_ms < sparse_ms[sparse_ms > 200][0])
        assert in_gap.sum() > 8
        assert np.isnan(newtons[in_gap]).all() == missing
        assert output.attributes["ft_rows_without_truth"] == np.isnan(newtons).sum()
        assert len(t_ms) == len(SKIN_MS)


def test_an_empty_cell_is_no_sample() -> None:
    newtons = FORCE_N.copy()
    newtons[1::2] = np.nan
    output = run({"skin": skin(), "ft": force(newtons=newtons)})
    t_ms, values = rows_and_values(output, "ft_force_z")
    inside = within(t_ms, FORCE_MS[::2])
    np.testing.assert_allclose(values[inside], np.interp(t_ms[inside], FORCE_MS[::2], FORCE_N[::2]), atol=1e-9)
    assert output.rows["ft"] == RowCounts(30, 15, {"in a gap or without a value": 15})


def test_many_rows_without_truth_are_named() -> None:
    (note,) = run({"skin": skin(), "ft": force()}).notes
    assert note.startswith("More than 1% of the rows have no ft_force_z: they are outside its samples")
    assert not run({"skin": skin(), "ft": force(SKIN_MS - 1, SKIN_MS * 1.0)}).notes[1:]


def test_truth_has_no_masks_and_no_part_in_what_rows_know() -> None:
    output = run({"skin": skin(), "ft": force()})
    table, without = output.streams[""], run({"skin": skin()}, truth="").streams[""]
    assert table.column_names == [*without.column_names, "ft_force_z"]
    assert table.select(without.column_names) == without
    assert (output.attributes["look_ahead_mean_ms"], output.attributes["look_ahead_max_ms"]) == (0.0, 0.0)
    assert [name for name in output.attributes if name.startswith("ft_")] == ["ft_rows_without_truth"]
    assert is_truth(table.schema.field("ft_force_z"))
    assert not any(is_truth(field) for field in without.schema)


def test_columns_of_the_stream_that_no_pattern_matches_are_held() -> None:
    probe = sensor(
        force=(FORCE_N, schema.float_field("force_z", "N", "force", "z")),
        depth=(FORCE_MS * 1.0, schema.float_field("depth", "mm", "position", "z")),
    )
    output = run({"skin": skin(), "ft": probe}, truth="ft_force_*")
    table, held = output.streams[""], run({"skin": skin(), "ft": probe}, truth="").streams[""]
    for name in ("t_ns", "ft_depth", "ft_held", "ft_gap", "ft_dt_ns"):
        assert table.column(name) == held.column(name)
    t_ms, newtons = rows_and_values(output, "ft_force_z")
    np.testing.assert_allclose(newtons, np.where(within(t_ms), np.interp(t_ms, FORCE_MS, FORCE_N), np.nan), atol=1e-9)
    assert [field.name for field in table.schema if is_truth(field)] == ["ft_force_z"]


@pytest.mark.parametrize(("unit", "turn"), [("deg", 360.0), ("rad", 2 * np.pi)])
@pytest.mark.parametrize("quantity", ["angle", "joint_position"])
def test_angles_take_the_shorter_arc(unit: str, turn: float, quantity: str) -> None:
    angles = np.linspace(0, 3.3 * turn, len(FORCE_MS))
    tables = {"skin": skin(), "ft": sensor(angle=(angles % turn, schema.float_field("yaw", unit, quantity)))}
    t_ms, values = rows_and_values(run(tables), "ft_yaw")
    inside = within(t_ms)
    distance = values[inside] - np.interp(t_ms[inside], FORCE_MS, angles)
    np.testing.assert_allclose((distance + turn / 2) % turn - turn / 2, 0, atol=1e-9)
    assert ((values[inside] >= -0.2 * turn) & (values[inside] <= turn)).all()


def test_labels_and_texts_are_those_of_the_nearest_sample_and_empty_outside() -> None:
    labels = (np.arange(30) % 3, schema.label_field("phase"))
    table = sensor(force=(FORCE_N, schema.float_field("force_z", "N", "force")), phase=labels)
    table = table.append_column(pa.field("doing", pa.string()), pa.array([f"step {row}" for row in range(30)]))
    output = run({"skin": skin(), "ft": table}).streams[""]
    t_ms = (output.column("t_ns").to_numpy() - T0) / MS
    nearest = np.abs(FORCE_MS[None] - t_ms[:, None]).argmin(axis=1)
    for row, is_inside in enumerate(within(t_ms)):
        assert output.column("ft_phase")[row].as_py() == (int(nearest[row] % 3) if is_inside else None)
        assert output.column("ft_doing")[row].as_py() == (f"step {nearest[row]}" if is_inside else None)
    assert output.schema.field("ft_phase").type == pa.int8()


def test_a_quaternion_stays_one() -> None:
    turned = np.random.default_rng(1).normal(size=(30, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    fields = schema.pose_fields()[3:]
    tables = {"skin": skin(), "ft": schema.stream(T0 + FORCE_MS * MS, turned.T, fields)}
    output = run(tables).streams[""]
    parts = np.column_stack([output.column(f"ft_orientation_{part}").to_numpy() for part in "xyzw"])
    t_ms = (output.column("t_ns").to_numpy() - T0) / MS
    np.testing.assert_allclose(np.linalg.norm(parts[within(t_ms)], axis=1), 1)
    assert np.isnan(parts[~within(t_ms)]).all()


@pytest.mark.parametrize("block_bytes", [1, 2_000])
def test_truth_that_is_read_in_blocks_is_that_of_one_block(monkeypatch: pytest.MonkeyPatch, block_bytes: int) -> None:
    turned = np.random.default_rng(1).normal(size=(4, 30))
    pose = [*(FORCE_N + axis for axis in range(3)), *turned]
    tables = {"skin": skin(), "ft": schema.stream(T0 + FORCE_MS * MS, pose, schema.pose_fields())}
    expected = run(tables)
    module = sys.modules[synchronize.function.__module__]
    monkeypatch.setattr(module, "IN_MEMORY", 1000)
    monkeypatch.setattr(module, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(grids, "POINTS", 7)
    monkeypatch.setattr(columns.Columns.batches, "__defaults__", (None, 13))
    output = run(tables)
    table = output.streams[""].read_all()
    for name in table.column_names:
        np.testing.assert_array_equal(table.column(name).to_numpy(), expected.streams[""].column(name).to_numpy())
    assert (output.attributes, output.rows) == (expected.attributes, expected.rows)


def test_late_samples_of_truth_are_counted() -> None:
    sampled = sensor(seq=(np.arange(30), pa.field("seq", pa.int64(), metadata={"quantity": "sequence"})))
    counter = sampled.column("seq").to_numpy().copy()
    counter[[4, 5]] = counter[[5, 4]]
    table = force().append_column(sampled.schema.field("seq"), pa.array(counter))
    arrivals = schema.time_field(arrivals=True, period_ns=9 * MS)
    table = table.set_column(0, arrivals, table.column("t_ns"))
    counts = run({"skin": skin(), "ft": table}).rows["ft"]
    assert counts.read == 30
    assert counts.unused == {"late": 1}


@pytest.mark.parametrize(
    ("truth", "values", "words"),
    [
        ("ft_torque*", {}, "no column that --truth 'ft_torque*' matches; after synchronize its columns are"),
        ("ft_*,nothing", {}, "--truth 'nothing' matches"),
        ("*", {}, "All columns of recording trial are --truth"),
        ("ft_*", {"master": "ft"}, "All columns of ft, the master of recording trial, are --truth"),
    ],
)
def test_a_pattern_that_leaves_nothing_to_do_is_refused(truth: str, values: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError) as error:
        run({"skin": skin(), "ft": force()}, truth=truth, **values)
    assert words in str(error.value)


def test_a_stream_is_truth_as_a_whole_if_all_that_it_measured_is() -> None:
    counted = force().append_column(pa.field("seq", pa.int64()), pa.array(np.arange(30)))
    schemas = {"skin": skin().schema, "ft": counted.schema}
    assert truth_columns(schemas, "ft_force_z", "trial") == {"ft": ("force_z", "seq")}
    assert truth_columns(schemas, "ft_seq", "trial") == {"ft": ("seq",)}


def test_without_truth_a_key_is_what_it_was() -> None:
    assert "truth" not in to_json(synchronize.params())
    assert to_json(synchronize.params(truth="ft_*"))["truth"] == "ft_*"


def test_no_stage_reads_truth_as_input() -> None:
    mark = {TRUTH_KEY: "1", "unit": "N", "stream": "ft"}
    fields = [
        pa.field("t_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}),
        pa.field("skin_taxel01_x", pa.float32(), metadata={"unit": "count", "quantity": "tactile", "stream": "skin"}),
        *(
            pa.field(f"ft_{quantity}_{axis}", pa.float64(), metadata={**mark, "quantity": quantity, "component": axis})
            for quantity in ("force", "tactile", "position", "velocity", "static_pressure", "proximity", "latent")
            for axis in "xyz"
        ),
    ]
    table = pa.table(
        [pa.array(np.arange(5) * int(kind.name == "t_ns"), kind.type) for kind in fields], pa.schema(fields)
    )
    for quantity in ("force", "position", "velocity", "static_pressure", "proximity", "latent"):
        assert tactile.columns(table.schema, quantity) == ()
        assert streams.columns_with_quantity(table, quantity) == []
    assert tactile.columns(table.schema, "tactile") == ("skin_taxel01_x",)
    assert [field.name for field in table.schema if is_channel(field)] == ["skin_taxel01_x"]
    segment_contacts = sys.modules[load("segment.contacts").function.__module__]
    assert segment_contacts._tactile_columns("trial", table.schema) == {"skin": ["skin_taxel01_x"]}
    shard: Any = FakeShard("trial", table)
    (_, values) = slides.frames(shard, "uskin", ["tactile", "force"])
    assert values.shape == (5, 1)
    assert arm.pose(table.schema, "", needed=False).position == ()
    checked = Stream("trial", "", "", FakeRecording({"": table}).columns())
    assert [field.name for field in checked.channels()] == ["skin_taxel01_x"]
