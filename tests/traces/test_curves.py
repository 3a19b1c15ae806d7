"""Curves: which channels share a plot, and under which names."""

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema
from tacpipe.traces import curves
from tests.viewer import hand


def test_channels_of_one_quantity_and_unit_share_a_plot_and_clocks_have_none() -> None:
    plots = curves.curves_of_table("robot", hand.arm())

    assert [(plot.title, plot.names) for plot in plots] == [
        ("robot position (m)", ("x", "y", "z")),
        ("robot orientation", ("x", "y", "z", "w")),
    ]
    np.testing.assert_array_equal(plots[0].values[:, 0], hand.arm()["position_x_m"].to_numpy())


def test_taxels_labels_masks_and_pictures_are_no_curves() -> None:
    streams = {"xela1": hand.finger(hand.pressed()), "marks": hand.labels(), "camera": hand.camera()}

    assert curves.curves_of_streams(streams) == []


def test_readings_within_a_row_become_one_curve_at_their_own_rate() -> None:
    table = schema.stream(np.arange(3) * 22_000, np.arange(44 * 3).reshape(3, 44).T, schema.biotac_fields())

    (vibration,) = [plot for plot in curves.curves_of_table("biotac", table) if plot.quantity == "vibration"]

    assert vibration.values.shape == (66, 1)
    np.testing.assert_array_equal(np.diff(vibration.t_ns), 1000)
    expected = np.concatenate([[row[f"pac{n:02d}"] for n in range(1, 23)] for row in table.to_pylist()])
    np.testing.assert_array_equal(vibration.values.ravel(), expected)


def test_nulls_are_nan() -> None:
    table = pa.table({"t_ns": [0, 1, 2], "a": pa.array([1, None, 3], pa.int16())})

    (curve,) = curves.curves_of_table("s", table)

    np.testing.assert_array_equal(curve.values.ravel(), [1, np.nan, 3])


def test_a_path_is_in_metres_with_the_orientation_beside_it() -> None:
    (path,) = curves.paths_of_table("robot", hand.arm())

    assert path.name == "robot" and path.quaternion is not None
    np.testing.assert_allclose(path.position_m[-1], [0.3999, 0, 0.5])
    cm = [schema.float_field(f"p_{axis}", "cm", "position", axis) for axis in "xyz"]
    (marker_path,) = curves.paths_of_table("m", schema.stream(np.arange(2), [[100, 200], [0, 0], [5, 5]], cm))
    np.testing.assert_allclose(marker_path.position_m, [[1, 0, 0.05], [2, 0, 0.05]])


def test_two_points_of_one_stream_are_two_paths_and_a_cloud_is_none() -> None:
    fields = [
        schema.float_field(f"{point}_{axis}_m", "m", "position", axis) for point in ("g1", "g2") for axis in "xyz"
    ]
    grasp = schema.stream(np.array([0]), np.arange(6.0)[:, None], fields)

    assert [(path.name, path.position_m.tolist()) for path in curves.paths_of_table("grasp", grasp)] == [
        ("grasp g1", [[0, 1, 2]]),
        ("grasp g2", [[3, 4, 5]]),
    ]
    cloud = pa.table({"t_ns": [0] * 9, **{f"{axis}_m": np.arange(9.0) for axis in "xyz"}})
    assert curves.paths_of_table("cloud", cloud) == []


def test_forecasts_of_the_channel_that_varies_most_stand_at_the_times_that_they_are_for() -> None:
    rows = np.arange(6.0)
    columns = {"flat": 0 * rows, "flat_t1": 0 * rows, "load": rows, "load_t1": rows + 1, "load_t3": rows + 3}
    fields = [pa.field(curves.TIME, pa.int64())]
    for name in columns:
        step = {"step": name[-1]} if "_t" in name else {}
        quantity = "prediction" if step else "tactile"
        fields.append(pa.field(name, pa.float64(), metadata={"quantity": quantity, "unit": "N", **step}))
    table = pa.Table.from_arrays([pa.array(np.arange(6)), *map(pa.array, columns.values())], schema=pa.schema(fields))
    (drawn,) = curves.curves_of_table("skin", table)
    assert drawn.names == ("measured", "forecast 1 row ahead", "forecast 3 rows ahead")
    assert (drawn.title, drawn.unit) == ("skin load (N)", "N")
    for column, ahead in ((1, 1), (2, 3)):  # each forecast is right, so it is the measurement where it is drawn
        assert np.isnan(drawn.values[:ahead, column]).all()
        assert (drawn.values[ahead:, column] == rows[ahead:]).all()
