"""Clouds from a folder or a camera: the same points that open3d reads, and a scene that `segment grasps` can read."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.clouds import files, point_files
from tacpipe.clouds.cloud import Cloud, DepthFrame
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.clouds import Clouds
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples

HEAD = "ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\n{kinds}\nend_header\n"
KINDS = "\n".join(
    [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {name}" for name in ("red", "green", "blue"))]
)
TEXT_PLY = HEAD.format(form="ascii", count=2, kinds=KINDS).encode() + b"0.1 0.2 0.7 255 0 9\n0.3 -0.2 0.8 1 2 3\n"
PCD = b"""VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F U
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
POINTS 2
DATA ascii
0.1 0.2 0.7 16711689
nan nan nan 0
"""


def random_cloud(points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(points, 3)).astype(np.float32), rng.integers(0, 256, (points, 3)).astype(np.uint8)


def frame() -> DepthFrame:
    """Return a depth image of 2 rows and 3 columns, millimetres, one pixel unseen."""
    depth = np.array([[500, 0, 600], [700, 800, 900]], np.uint16)
    colours = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    return DepthFrame(depth, (100.0, 200.0), (1.0, 0.5), 0.001, colours)


def test_each_point_of_a_cloud_is_a_row_with_the_clouds_stamp() -> None:
    batch = LinkReader(Clouds()).feed(Chunks.from_pairs([(100, TEXT_PLY), (200, PCD)]))

    assert batch.t_ns.tolist() == [100, 100, 200]  # the point that is not a number was not seen
    np.testing.assert_allclose(batch.values[0], [[0.1, 0.2, 0.7], [0.3, -0.2, 0.8], [0.1, 0.2, 0.7]], rtol=1e-6)
    assert batch.values[1].tolist() == [[255, 0, 9], [1, 2, 3], [255, 0, 9]]


def test_a_stream_of_clouds_has_the_columns_of_a_scene() -> None:
    import pyarrow as pa

    sensor = Clouds()
    samples = sensor.decode([TEXT_PLY])

    columns = [pa.array(np.ascontiguousarray(column)) for block in samples.values for column in block.T]
    scene = Cloud.from_table(
        pa.Table.from_arrays([pa.array([1, 1]), *columns], names=["t_ns", *(f.name for f in sensor.fields())])
    )
    assert scene.colours is not None and scene.colours[0].tolist() == [255, 0, 9]
    assert [field.type for field in sensor.fields()] == [pa.float32()] * 3 + [pa.uint8()] * 3


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_open3d_reads_the_same_points_of_a_file(form: str, tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="open3d is not installed")
    points, colours = random_cloud(50, 1)
    kinds = KINDS.replace("property uchar red", "property double quality\nproperty uchar red")
    rows = np.zeros(
        50, np.dtype([*((axis, "f4") for axis in "xyz"), ("quality", "f8"), *((name, "u1") for name in "rgb")])
    )
    for column, name in enumerate("xyz"):
        rows[name] = points[:, column]
    for column, name in enumerate("rgb"):
        rows[name] = colours[:, column]
    if form == "ascii":
        body = "\n".join(" ".join(repr(value) for value in row.item()) for row in rows).encode()
    else:
        body = rows.astype(rows.dtype.newbyteorder("<" if "little" in form else ">")).tobytes()
    path = tmp_path / "cloud.ply"
    path.write_bytes(HEAD.format(form=form, count=50, kinds=kinds).encode() + body)

    samples, expected = Clouds().decode([path.read_bytes()]), files.read(path)

    np.testing.assert_array_equal(samples.values[0], expected.points_m)
    np.testing.assert_array_equal(samples.values[1], expected.colours)


def test_millimetres_become_metres() -> None:
    points_m = Clouds(unit_m=0.001).decode([TEXT_PLY]).values[0]

    np.testing.assert_allclose(points_m[0], [1e-4, 2e-4, 7e-4], rtol=1e-6)


def test_a_depth_image_becomes_the_points_that_were_measured() -> None:
    samples = Clouds(unit_m=0.001).decode([frame().to_bytes()])  # the unit is that of files alone

    # x = (column - 1) z / 100, y = (row - 0.5) z / 200, worked out by hand
    expected = [
        [-0.005, -0.00125, 0.5],
        [0.006, -0.0015, 0.6],
        [-0.007, 0.00175, 0.7],
        [0.0, 0.002, 0.8],
        [0.009, 0.00225, 0.9],
    ]
    np.testing.assert_allclose(samples.values[0], expected, atol=1e-8)
    assert samples.values[1][:2].tolist() == [[0, 1, 2], [6, 7, 8]]


def test_a_depth_image_is_what_its_bytes_say() -> None:
    restored = DepthFrame.from_bytes(frame().to_bytes())

    assert restored.depth.tolist() == frame().depth.tolist()
    assert restored.colours is not None and restored.colours.tolist() == np.arange(18).reshape(2, 3, 3).tolist()
    assert (restored.focal, restored.centre) == ((100.0, 200.0), (1.0, 0.5))
    for content in (b"", frame().to_bytes()[:-1], b"X" + frame().to_bytes()[1:]):
        with pytest.raises(TacpipeError):
            DepthFrame.from_bytes(content)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\n",
        TEXT_PLY[:-8],
        TEXT_PLY.replace(b"0.8", b"o.8"),
        TEXT_PLY.replace(b"float x", b"int x"),
        TEXT_PLY.replace(b"uchar red", b"float red"),
        TEXT_PLY.replace(b"property float y", b"property list uchar int y"),
        TEXT_PLY.replace(b"element vertex", b"element face"),
        TEXT_PLY.replace(b"ascii", b"binary_little_endian"),
        PCD.replace(b"POINTS 2", b"POINTS 3"),
        PCD[:-12],
        frame().to_bytes()[:-1],
    ],
)
def test_what_is_no_whole_cloud_is_malformed(content: bytes) -> None:
    runs, losses = Clouds().framer().feed(Chunks.from_pairs([(1, content), (2, TEXT_PLY)]))

    assert [run.t_ns.tolist() for run in runs] == [[2]]
    assert [(loss.t_ns, loss.cause) for loss in losses] == [(1, "malformed")]


def test_a_cloud_without_the_colours_that_the_rig_tells_of_is_refused() -> None:
    points, colours = random_cloud(3, 0)
    bare, coloured = point_files.pack_ply(points, None), point_files.pack_ply(points, colours)

    for sensor, right in ((Clouds(colour=False), bare), (Clouds(), coloured)):
        runs, losses = sensor.framer().feed(Chunks.from_pairs([(1, bare), (2, coloured)]))
        assert [run.frames for run in runs] == [[right]]
        assert len(losses) == 1


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 30), max_size=4), st.booleans())
def test_what_is_encoded_is_decoded(seed: int, sizes: list[int], colour: bool) -> None:
    points, colours = random_cloud(sum(sizes), seed)
    rows = np.repeat(np.arange(len(sizes)), sizes)
    sensor = Clouds(colour=colour)

    frames = sensor.encode(Samples((points, colours) if colour else (points,), rows=rows)) if sizes else []
    decoded = sensor.decode(frames)

    assert not sensor.framer().feed(Chunks.from_pairs(list(enumerate(frames))))[1]
    np.testing.assert_array_equal(decoded.values[0], points)
    if colour:
        np.testing.assert_array_equal(decoded.values[1], colours)
    np.testing.assert_array_equal(decoded.rows, rows)


def test_a_unit_of_nothing_is_refused() -> None:
    with pytest.raises(UsageError, match="unit_m is 0"):
        Clouds(unit_m=0)
