"""Test that PCD files of open3d are read, that open3d reads ours, and that invalid files are rejected."""

from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tacpipe.clouds import point_files
from tacpipe.errors import TacpipeError
from tests.formats.grasp_files import colours, header, packed, points_m

FLOATS = st.floats(-100, 100, width=32)
CLOUDS = st.integers(1, 20).flatmap(
    lambda count: st.tuples(arrays.arrays(np.float32, (count, 3), elements=FLOATS), arrays.arrays(np.uint8, (count, 3)))
)


def write(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@settings(max_examples=50, deadline=None)
@given(cloud=CLOUDS, text=st.booleans())
def test_a_cloud_that_open3d_wrote_is_read_with_its_colours(
    tmp_path_factory: pytest.TempPathFactory, cloud: tuple[np.ndarray, np.ndarray], text: bool
) -> None:
    points, rgb = cloud
    values = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    values.colors = open3d.utility.Vector3dVector(rgb / 255)
    path = tmp_path_factory.mktemp("cloud") / "cloud.pcd"
    assert open3d.io.write_point_cloud(path, values, write_ascii=text)
    result = point_files.read(path)
    np.testing.assert_allclose(result.points_m, points, rtol=0, atol=1e-9 if text else 0)
    np.testing.assert_array_equal(np.asarray(result.colours), rgb)


@settings(max_examples=50, deadline=None)
@given(cloud=CLOUDS)
def test_the_published_layout_is_read_as_open3d_reads_it(
    tmp_path_factory: pytest.TempPathFactory, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    points, rgb = cloud
    path = tmp_path_factory.mktemp("cloud") / "cloud.pcd"
    write(path, header(len(points)).encode() + packed(points, rgb) + bytes(3916))
    result, theirs = point_files.read(path), open3d.io.read_point_cloud(path)
    np.testing.assert_array_equal(result.points_m, np.asarray(theirs.points).astype(np.float32))
    np.testing.assert_array_equal(np.asarray(result.colours), np.rint(np.asarray(theirs.colors) * 255))
    np.testing.assert_array_equal(result.points_m, points)
    np.testing.assert_array_equal(np.asarray(result.colours), rgb)


def test_fields_stand_in_any_order_and_further_ones_are_skipped(tmp_path: Path) -> None:
    layout = np.dtype([("n", "<f4", (3,)), ("rgb", "<u4"), ("z", "<f8"), ("_", "u1", (2,)), ("y", "<f8"), ("x", "<f8")])
    points = np.zeros(50, layout)
    for place, axis in enumerate("xyz"):
        points[axis] = points_m()[:, place]
    points["rgb"], points["n"], points["_"] = 0xAB_12_34_56, np.nan, 7  # the highest byte is no colour
    head = header(50, FIELDS="n rgb z _ y x", SIZE="4 4 8 1 8 8", TYPE="F U F U F F", COUNT="3 1 1 2 1 1", VERSION=".7")
    result = point_files.read(write(tmp_path / "cloud.pcd", head.encode() + points.tobytes()))
    np.testing.assert_array_equal(result.points_m, points_m())
    assert np.asarray(result.colours).tolist() == [[0x12, 0x34, 0x56]] * 50


def test_lines_of_text_are_points_and_colours_are_the_bits_of_their_float(tmp_path: Path) -> None:
    bits = np.array([0x00FF8001, 0x0000007F], np.uint32).view(np.float32)
    rows = [f"{2 * row}.5 -1e-2 3 {float(value):.9g} 4 5" for row, value in enumerate(bits)]
    head = header(2, "ascii", FIELDS="x y z rgb w", SIZE="4 4 4 4 4", TYPE="F F F F F", COUNT="1 1 1 1 2")
    result = point_files.read(write(tmp_path / "cloud.pcd", head + "\n".join(rows) + "\n"))
    np.testing.assert_allclose(result.points_m, [(0.5, -0.01, 3), (2.5, -0.01, 3)])
    assert np.asarray(result.colours).tolist() == [[255, 128, 1], [0, 0, 127]]


def test_a_cloud_without_rgb_has_no_colours_and_count_may_be_left_out(tmp_path: Path) -> None:
    head = header(50, FIELDS="x y z", SIZE="4 4 4", TYPE="F F F", COUNT="")
    result = point_files.read(write(tmp_path / "cloud.pcd", head.encode() + points_m().tobytes()))
    assert result.colours is None
    np.testing.assert_array_equal(result.points_m, points_m())


WHOLE = packed(points_m(), colours())
LINE = "1 2 3 0\n"


@pytest.mark.parametrize(
    ("content", "value"),
    [
        (b"", "DATA"),
        (b"ply\nformat ascii 1.0\n", "'ply'.* VERSION"),
        (b"\x89PNG\r\n\x1a\n" + bytes(99), "PNG"),
        (header(50).encode()[:60], "DATA"),
        (header(50, VERSION="0.6").encode() + WHOLE, "version 0.6"),
        (header(50, VERSION="").encode() + WHOLE, "VERSION"),
        (header(50, POINTS="many").encode() + WHOLE, "POINTS many"),
        (header(50, POINTS="-3").encode() + WHOLE, "POINTS -3"),
        (header(50, WIDTH="5").encode() + WHOLE, "WIDTH 5, HEIGHT 1 and POINTS 50"),
        (header(10**15).encode() + WHOLE, "1000000000000000 points of 16 bytes, and 50 "),
        (header(50).encode() + WHOLE[:-1], "50 points of 16 bytes, and 49 "),
        (header(49).encode() + WHOLE, "49 points.* 16 bytes"),
        (header(0).encode(), "POINTS 0"),
        (header(50, "binary_compressed").encode() + WHOLE, "DATA binary_compressed"),
        (header(50, "packed").encode() + WHOLE, "DATA packed"),
        (header(50, FIELDS="x y w rgb").encode() + WHOLE, "FIELDS x y w rgb"),
        (header(50, FIELDS="x y z x").encode() + WHOLE, "FIELDS x y z x"),
        (header(50, SIZE="4 4 4").encode() + WHOLE, r"4 FIELDS \(x y z rgb\) and 3 in SIZE"),
        (header(50, TYPE="F F U F").encode() + WHOLE, "field z of TYPE U, SIZE 4 and COUNT 1"),
        (header(50, SIZE="4 4 2 4").encode() + WHOLE, "field z of TYPE F and SIZE 2"),
        (header(50, TYPE="F F F Q").encode() + WHOLE, "field rgb of TYPE Q"),
        (header(50, COUNT="1 1 1 3").encode() + WHOLE, "field rgb of .*COUNT 3"),
        (header(3, "ascii").encode() + 2 * LINE.encode(), "3 points.* 2 lines"),
        (header(2, "ascii").encode() + f"{LINE}1 2 3\n".encode(), "4 numbers.* 3 at row 2"),
        (header(2, "ascii").encode() + f"{LINE}1 zwei 3 0\n".encode(), "'zwei'.* row 1"),
        (header(1, "ascii", TYPE="F F F U").encode() + b"1 2 3 -1\n", "point 0: rgb is -1; .* 0 to 4294967295"),
        (header(1, "ascii", TYPE="F F F U").encode() + b"1 2 3 1.5\n", "point 0: rgb is 1.5; "),
        (header(2, "ascii").encode() + f"{LINE}1 nan 3 0\n".encode(), r"1 of 2 points .*NaN"),
        (header(1, "ascii").encode() + b"\xff\xfe 1 2 3\n", "4 numbers"),
        (header(1, "ascii").encode() + b"1 2 3\n", "3 numbers; .* 4"),
    ],
)
def test_what_is_no_cloud_or_not_whole_is_refused_with_the_file(tmp_path: Path, content: bytes, value: str) -> None:
    path = write(tmp_path / "cloud.pcd", content)
    with pytest.raises(TacpipeError, match=rf"cloud\.pcd.*{value}"):
        point_files.read(path)


def test_points_that_are_not_finite_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    points = points_m()
    points[[7, 31], [0, 2]] = np.nan, np.inf
    path = write(tmp_path / "cloud.pcd", header(50).encode() + packed(points, colours()))
    with pytest.raises(TacpipeError, match=r"2 of 50 points.*point 7"):
        point_files.read(path)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=r"cloud\.pcd"):
        point_files.read(tmp_path / "cloud.pcd")


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_read_and_never_anything_else(
    tmp_path_factory: pytest.TempPathFactory, data: Any
) -> None:
    content = bytearray(header(50).encode() + WHOLE)
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=8)):
        content[place] = data.draw(st.integers(0, 255))
    path = write(tmp_path_factory.mktemp("cloud") / "cloud.pcd", bytes(content[: data.draw(st.integers(0, 1100))]))
    try:
        assert len(point_files.read(path)) > 0
    except TacpipeError as error:
        assert "cloud.pcd" in str(error)
