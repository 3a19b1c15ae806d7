"""Files of clouds that open3d wrote, whole and damaged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest

from tacpipe.clouds.files import SUFFIXES, read
from tacpipe.errors import TacpipeError
from tests.formats.grasp_files import colours, points_m

COLOURED = (".ply", ".pcd", ".pts", ".xyzrgb")
WAYS = [
    ("cloud.ply", {}),
    ("cloud.ply", {"write_ascii": True}),
    ("cloud.pcd", {}),
    ("cloud.pcd", {"write_ascii": True}),
]
WAYS += [("cloud.pcd", {"compressed": True}), ("cloud.pts", {}), ("cloud.xyz", {}), ("cloud.xyzrgb", {})]


def write(path: Path, points: np.ndarray, rgb: np.ndarray | None = None, **how: Any) -> Path:
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    if rgb is not None:
        made.colors = open3d.utility.Vector3dVector(rgb / 255)
    assert open3d.io.write_point_cloud(path, made, **how)
    return path


@pytest.mark.parametrize(("name", "how"), WAYS)
def test_points_and_colours_are_read_as_they_were_written(tmp_path: Path, name: str, how: dict[str, bool]) -> None:
    found = read(write(tmp_path / name, points_m(), colours(), **how))
    np.testing.assert_allclose(
        found.points_m, points_m(), rtol=0, atol=1e-5 if "write_ascii" in how else 1e-7
    )  # of six digits
    assert found.points_m.dtype == np.float32
    if Path(name).suffix in COLOURED:
        np.testing.assert_array_equal(np.asarray(found.colours), colours())
    else:
        assert found.colours is None


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "CLOUD.PLY"])
def test_a_cloud_without_colours_has_none(tmp_path: Path, name: str) -> None:
    written = write(tmp_path / name.lower(), points_m()).rename(tmp_path / name)
    assert read(written).colours is None


@pytest.mark.parametrize(("name", "how"), WAYS)
@pytest.mark.parametrize("share", [0.1, 0.4, 0.7, 0.98])
def test_a_file_that_was_cut_off_is_never_read_as_fewer_points(
    tmp_path: Path, name: str, how: dict[str, bool], share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / name, points_m(), colours(), **how)
    content = path.read_bytes()
    lines = path.suffix in (".xyz", ".xyzrgb")  # tell no number of points: seen is the line that was cut
    cut = content.rfind(b"\n", 0, int(share * len(content))) + 9 if lines else int(share * len(content))
    path.write_bytes(content[:cut])
    with pytest.raises(TacpipeError, match=rf"{name}.*(cut off|no PCD|no PLY|can be read)"):
        read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cloud.ply", b"\x00\x01 not a cloud", "is not a PLY file, or was cut off"),
        ("cloud.ply", b"ply\nformat ascii 1.0\nend_header\n", "declares no points"),
        (
            "cloud.ply",
            b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n",
            "has the line 'element vertex many'",
        ),
        ("cloud.ply", b"", "is empty"),
        ("cloud.pcd", b"\x00" * 99, "is not a PCD file"),
        ("cloud.xyz", b"# nothing\n\n", "declares 0 points"),
        ("cloud.xyz", b"1 2 3\nhello\n4 5 6\n", "declares 3 points, and 2 can be read"),
        ("cloud.xyz", b"1 2 3\nnan 1 2\n", r"holds 1 of 2 points that are not finite \(NaN\), the first being point 1"),
        ("cloud.pts", b"1 2 3\n4 5 6\n", "its first line must be the number of points"),
        ("cloud.pts", b"3\n1 2 3\n4 5 6\n", "declares 3 points, and 2 can be read"),
        ("cloud.xyzrgb", b"1 2 3 255 0 0\n1 2 3 9 9 9\n", "has colours from 0 to 255; in its format they are shares"),
        ("cloud.stl", b"1 2 3\n", "is not a cloud that can be read; it must end in one of .pcd, .ply"),
        ("cloud", b"1 2 3\n", "is not a cloud that can be read"),
    ],
)
def test_what_is_no_cloud_is_refused_with_the_file(
    tmp_path: Path, name: str, content: bytes, message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(TacpipeError, match=message) as raised:
        read(path)
    assert str(path) in str(raised.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "cloud.pts"])
def test_points_that_are_not_finite_are_counted_and_nothing_is_dropped(tmp_path: Path, name: str) -> None:
    points = points_m()
    points[[5, 9]] = np.nan
    with pytest.raises(TacpipeError, match="holds 2 of 50 points that are not finite"):
        read(write(tmp_path / name, points))


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "cloud.xyz"])
def test_a_cloud_of_many_metres_looks_like_millimetres(tmp_path: Path, name: str) -> None:
    with pytest.raises(TacpipeError, match=r"is 9\d(\.\d+)? m long; .* It looks like millimetres"):
        read(write(tmp_path / name, 1000 * points_m()))
    assert len(read(write(tmp_path / name, 50 * points_m()))) == 50


def test_a_mesh_gives_its_vertices(tmp_path: Path) -> None:
    box = open3d.geometry.TriangleMesh.create_box(0.1, 0.2, 0.3)
    for text in (True, False):
        open3d.io.write_triangle_mesh(tmp_path / "mesh.ply", box, write_ascii=text)
        np.testing.assert_allclose(read(tmp_path / "mesh.ply").points_m, np.asarray(box.vertices), atol=1e-7)


def test_elements_before_the_points_are_counted_too(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement vertex 2\nproperty float x\n"
    text = head + "property float y\nproperty float z\nend_header\n35\n1 2 3\n4 5 6\n"
    path = tmp_path / "cloud.ply"
    path.write_text(text)
    np.testing.assert_array_equal(read(path).points_m, [(1, 2, 3), (4, 5, 6)])
    path.write_text(text.removesuffix(" 6\n"))
    with pytest.raises(TacpipeError, match="its 2 rows of vertex are 6 numbers, and 5 follow"):
        read(path)


def test_a_file_or_folder_that_is_no_file_is_told(tmp_path: Path) -> None:
    for suffix in SUFFIXES:
        with pytest.raises(TacpipeError, match=rf"There is no file .*cloud{suffix}"):
            read(str(tmp_path / f"cloud{suffix}"))
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(TacpipeError, match="There is no file"):
        read(tmp_path / "folder.ply")
