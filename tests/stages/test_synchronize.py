"""Streams on one clock: values, types, masks and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation, Slerp

from tacpipe.errors import TacpipeError
from tacpipe.formats import channels
from tacpipe.registry import load
from tacpipe.stage import Recording

T0 = 1_637_771_974_778_354_001
MS = 1_000_000
synchronize = load("synchronize")
Shard = Callable[..., Any]


def params(**values: Any) -> Any:
    return synchronize.params(**values)


def uskin(t_ms: np.ndarray, values: np.ndarray | None = None) -> pa.Table:
    if values is None:
        values = np.random.default_rng(0).integers(0, 65_536, (len(t_ms), 48))
    return channels.stream(T0 + np.asarray(t_ms) * MS, values.T, channels.uskin_fields())


def robot(t_ms: np.ndarray) -> pa.Table:
    turned = Rotation.random(len(t_ms), rng=np.random.default_rng(1)).as_quat()
    pose = np.column_stack([np.sin(t_ms / 100), t_ms, t_ms * 2, turned])
    return channels.stream(T0 + np.asarray(t_ms) * MS, pose.T, channels.pose_fields())


def run(shard: Any, **values: Any) -> tuple[pa.Table, Any]:
    recording = synchronize(params(**values), shard)
    assert isinstance(recording, Recording)
    return recording.streams[""], recording.attributes


def test_the_grid_starts_with_the_first_tactile_stream_and_ends_where_a_stream_does(shard: Shard) -> None:
    table, attributes = run(
        shard(
            {"robot": robot(np.arange(-30, 95)), "xela2": uskin(np.arange(3, 200)), "xela1": uskin(np.arange(0, 150))}
        )
    )
    assert ((table.column("t_ns").to_numpy() - T0) / MS).tolist() == [20.0, 40.0, 60.0, 80.0]
    assert attributes["grid_master"] == "xela1"
    assert attributes["grid_rate_hz"] == 50.0


def test_values_are_those_of_numpy_interp_and_scipy_slerp(shard: Shard) -> None:
    t_ms = np.cumsum(np.random.default_rng(2).integers(1, 30, 40))
    tactile, arm = uskin(t_ms), robot(t_ms)
    table, _ = run(shard({"xela1": tactile, "robot": arm}), rate_hz=120.0)
    grid_ns = table.column("t_ns").to_numpy() - T0
    for name in ("taxel01_x", "taxel16_z"):
        wanted = np.interp(grid_ns, t_ms * MS, tactile.column(name).to_numpy().astype(float))
        np.testing.assert_allclose(table.column(f"xela1_{name}").to_numpy(), wanted, atol=0.01)
        assert table.schema.field(f"xela1_{name}").type == pa.float32()
    parts = [f"orientation_{part}" for part in "xyzw"]
    turned = Rotation.from_quat(np.column_stack([arm.column(part).to_numpy() for part in parts]))
    found = Rotation.from_quat(np.column_stack([table.column(f"robot_{part}").to_numpy() for part in parts]))
    assert (found * Slerp(t_ms * MS, turned)(grid_ns).inv()).magnitude().max() < 1e-6
    assert table.schema.field("robot_position_x_m").type == pa.float64()


def test_every_channel_tells_where_it_came_from_and_how(shard: Shard) -> None:
    labels = channels.stream(T0 + np.arange(1, 100, 3) * MS, [np.arange(33) % 2], [channels.label_field("slip")])
    t_ms = np.arange(0, 100, 9)
    table, _ = run(shard({"xela1": uskin(t_ms), "robot": robot(t_ms), "slip": labels}))
    for column, how, quantity in (
        ("xela1_taxel03_y", b"linear", b"tactile"),
        ("robot_orientation_w", b"slerp", b"orientation"),
        ("slip_slip", b"nearest", b"label"),
    ):
        metadata = table.schema.field(column).metadata
        assert (metadata[b"interpolation"], metadata[b"quantity"]) == (how, quantity)
        assert metadata[b"stream"].decode() == column.split("_")[0]
    assert table.schema.field("slip_slip").type == pa.int8()


def test_wide_integers_become_float64_and_device_clocks_stay_integers(shard: Shard) -> None:
    t_ms = np.arange(0, 100, 7)
    table = uskin(t_ms)
    table = table.append_column("wide", pa.array(t_ms * 10**9)).append_column("seq", pa.array(np.arange(len(t_ms))))
    found, _ = run(shard({"xela1": table}))
    assert found.schema.field("xela1_wide").type == pa.float64()
    assert found.schema.field("xela1_seq").type == pa.int64()


def test_holds_gaps_and_distances_are_marked(shard: Shard) -> None:
    t_ms = np.array([0, 20, 41, 60, 140, 160])
    values = np.repeat(np.arange(6)[:, None], 48, axis=1)
    values[2] = values[1]
    table, attributes = run(shard({"xela1": uskin(t_ms, values)}))
    assert table.column("xela1_held").to_pylist() == [False, False, True, *[False] * 6]
    assert table.column("xela1_gap").to_pylist() == [False] * 4 + [True] * 3 + [False] * 2
    assert table.column("xela1_dt_ns").to_pylist() == [0, 0, MS, 0, 20 * MS, 40 * MS, 20 * MS, 0, 0]
    assert attributes["xela1_rate_hz"] == pytest.approx(5 / 0.16)
    assert attributes["xela1_fresh_hz"] == pytest.approx(4 / 0.16)


def test_on_the_logged_grid_values_at_equal_stamps_stay_as_they_are(shard: Shard) -> None:
    t_ms = np.array([0, 10, 10, 25, 60])
    tactile, arm = uskin(t_ms), robot(t_ms[:-1])
    table, _ = run(shard({"xela1": tactile, "robot": arm, "other": robot(np.arange(-5, 70, 2))}), grid="logged")
    assert table.num_rows == 4
    for name in tactile.column_names[1:]:
        found = table.column(f"xela1_{name}")
        assert found.type == pa.uint16()
        assert found.to_pylist() == tactile.column(name).to_pylist()[:4]
    assert table.column("robot_orientation_x").to_pylist() == arm.column("orientation_x").to_pylist()
    assert table.schema.field("robot_orientation_x").metadata[b"interpolation"] == b"none"
    assert table.schema.field("other_orientation_x").metadata[b"interpolation"] == b"slerp"


def test_ground_truth_keeps_its_names_and_has_no_masks(shard: Shard) -> None:
    t_ms = np.arange(0, 200)
    truth = channels.stream(T0 + t_ms * MS, [t_ms / 2], [channels.float_field("gt_force_n", "N", "force")])
    table, attributes = run(shard({"xela1": uskin(t_ms), "truth": truth, "events": truth.slice(0, 0)}))
    assert table.column("gt_force_n").to_pylist() == [k * 10.0 for k in range(10)]
    assert not any("truth" in name or "events" in name for name in [*table.column_names, *attributes])


def test_an_unseen_marker_stays_unseen(shard: Shard) -> None:
    t_ms = np.arange(0, 100, 20)
    pose = np.repeat([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], 5, axis=0)
    pose[2] = np.nan
    marker = channels.stream(T0 + t_ms * MS, pose.T, channels.pose_fields())
    table, _ = run(shard({"xela1": uskin(t_ms), "marker": marker}), rate_hz=100.0)
    for column in ("marker_position_x_m", "marker_orientation_w"):
        assert np.isnan(table.column(column).to_numpy()).tolist() == [False] * 3 + [True] * 3 + [False] * 3


def test_time_that_runs_backwards_is_named_with_stream_and_row(shard: Shard) -> None:
    with pytest.raises(TacpipeError, match=r"Recording trial: the time of stream 'robot' runs backwards at row 2"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.array([0, 5, 4]))}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"grid": "even"}, "no grid 'even'"),
        ({"master": "camera"}, "no stream 'camera' to be master; it has robot, xela1"),
        ({"rate_hz": 0.0}, "gives no grid"),
    ],
)
def test_params_that_cannot_be_are_refused(shard: Shard, values: dict[str, Any], message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(9))}), **values)


def test_streams_without_common_time_rows_or_touch_are_refused(shard: Shard) -> None:
    with pytest.raises(TacpipeError, match="no time in common"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(20, 30))}))
    with pytest.raises(TacpipeError, match="stream 'robot' has no rows"):
        run(shard({"xela1": uskin(np.arange(9)), "robot": robot(np.arange(0))}))
    with pytest.raises(TacpipeError, match="no tactile stream"):
        run(shard({"robot": robot(np.arange(9))}))


def test_half_a_quaternion_is_refused(shard: Shard) -> None:
    t_ms = np.arange(0, 100, 7)
    with pytest.raises(TacpipeError, match="needs x, y, z and w once each"):
        run(shard({"xela1": uskin(t_ms), "robot": robot(t_ms).drop_columns(["orientation_w"])}))
