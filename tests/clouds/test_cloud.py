"""Test that invalid clouds are rejected, and that tables restore clouds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tacpipe.clouds.cloud import COLOUR, POSITION, Cloud, normals
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import from_parquet, to_parquet
from tests.clouds import shapes

POINTS = arrays.arrays(
    np.float32,
    st.tuples(st.integers(0, 20), st.just(3)),
    elements=st.floats(-10, 10, width=32, allow_nan=False),
)


@settings(deadline=None)  # the first table waits for pyarrow
@given(POINTS, st.booleans())
def test_a_table_and_its_bytes_give_back_the_cloud(points: np.ndarray, coloured: bool) -> None:
    colours = (np.abs(points) * 25).astype(np.uint8) if coloured else None
    cloud = Cloud(points, colours)
    back = Cloud.from_table(from_parquet(to_parquet(cloud.table())))
    assert back.points_m.dtype == np.float32
    np.testing.assert_array_equal(back.points_m, points)
    assert (back.colours is None) == (colours is None)
    if colours is not None and back.colours is not None:
        assert back.colours.dtype == np.uint8
        np.testing.assert_array_equal(back.colours, colours)


def test_a_table_tells_the_unit_and_component_of_each_column() -> None:
    table = Cloud(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8)).table()
    assert table.column_names == [*POSITION, *COLOUR]
    metadata = {
        field.name: {key.decode(): value.decode() for key, value in field.metadata.items()} for field in table.schema
    }
    assert metadata["y_m"] == {"unit": "m", "quantity": "position", "component": "y"}
    assert metadata["green"] == {"unit": "count", "quantity": "colour", "component": "green"}


def test_a_table_with_two_colours_alone_is_a_cloud_without_colours() -> None:
    table = Cloud(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8)).table()
    assert Cloud.from_table(table.drop_columns(["green"])).colours is None


def test_a_cloud_is_as_long_as_it_has_points() -> None:
    assert len(Cloud(np.zeros((7, 3), np.float32))) == 7
    assert len(Cloud(np.zeros((0, 3), np.float32))) == 0


@pytest.mark.parametrize(
    ("points", "colours", "sentence"),
    [
        (np.zeros((4, 2)), None, r"shape \(4, 2\)"),
        (np.zeros(3), None, r"shape \(3,\)"),
        (np.zeros((4, 3)), np.zeros((3, 3), np.uint8), r"Colours have the shape \(3, 3\)"),
        (
            np.array([[0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0]]),
            None,
            "2 of 3 points are not finite, the first being point 1",
        ),
    ],
)
def test_what_is_no_cloud_is_refused(points: np.ndarray, colours: np.ndarray | None, sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        Cloud(points.astype(np.float32), colours)


def test_normals_of_a_sphere_point_along_its_radius_and_towards_the_camera() -> None:
    cloud = shapes.sphere(0.05)
    unit_normals = normals(cloud, 0.008)
    radial = (cloud.points_m - shapes.PLACE_M) / 0.05
    towards = -(cloud.points_m * unit_normals).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(unit_normals, axis=1), 1, atol=1e-9)
    assert np.median(np.abs((unit_normals * radial).sum(axis=1))) > 0.999
    assert (towards >= 0).all()


def test_a_camera_elsewhere_turns_the_normals_towards_itself() -> None:
    grid = np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2) * 0.003
    plane = Cloud(np.column_stack([grid, np.full(len(grid), 1.0)]).astype(np.float32))
    np.testing.assert_allclose(normals(plane), np.tile([0, 0, -1.0], (len(grid), 1)), atol=1e-6)
    np.testing.assert_allclose(normals(plane, camera_m=(0, 0, 2)), np.tile([0, 0, 1.0], (len(grid), 1)), atol=1e-6)
