"""Files of clouds that open3d wrote, whole and damaged."""

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


def write(path: Path, points: np.ndarray, rgb: np.ndarray | None = None, **options: Any) -> Path:
    point_cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    if rgb is not None:
        point_cloud.colors = open3d.utility.Vector3dVector(rgb / 255)
    assert open3d.io.write_point_cloud(path, point_cloud, **options)
    return path


@pytest.mark.parametrize(("name", "options"), WAYS)
def test_points_and_colours_are_read_as_they_were_written(tmp_path: Path, name: str, options: dict[str, bool]) -> None:
    cloud = read(write(tmp_path / name, points_m(), colours(), **options))
    np.testing.assert_allclose(
        cloud.points_m, points_m(), rtol=0, atol=1e-5 if "write_ascii" in options else 1e-7
    )  # The text has six digits
    assert cloud.points_m.dtype == np.float32
    if Path(name).suffix in COLOURED:
        np.testing.assert_array_equal(np.asarray(cloud.colours), colours())
    else:
        assert cloud.colours is None


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "CLOUD.PLY"])
def test_a_cloud_without_colours_has_none(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name.lower(), points_m()).rename(tmp_path / name)
    assert read(path).colours is None


@pytest.mark.parametrize(("name", "options"), WAYS)
@pytest.mark.parametrize("share", [0.1, 0.4, 0.7, 0.98])
def test_a_file_that_was_cut_off_is_never_read_as_fewer_points(
    tmp_path: Path, name: str, options: dict[str, bool], share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / name, points_m(), colours(), **options)
    content = path.read_bytes()
    lines = path.suffix in (".xyz", ".xyzrgb")  # The file states no number of points: only a cut line is noticed
    cut = content.rfind(b"\n", 0, int(share * len(content))) + 9 if lines else int(share * len(content))
    path.write_bytes(content[:cut])
    with pytest.raises(TacpipeError, match=name):
        read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "content", "value"),
    [
        ("cloud.ply", b"\x00\x01 not a cloud", "PLY"),
        ("cloud.ply", b"ply\nformat ascii 1.0\nend_header\n", "ascii"),
        ("cloud.ply", b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "'vertex many'"),
        ("cloud.ply", b"", "empty"),
        ("cloud.pcd", b"\x00" * 99, "PCD"),
        ("cloud.xyz", b"# nothing\n\n", "0 points"),
        ("cloud.xyz", b"1 2 3\nhello\n4 5 6\n", "3 points.* 2 "),
        ("cloud.xyz", b"1 2 3\nnan 1 2\n", "1 of 2 points.*NaN.* point 1"),
        ("cloud.pts", b"1 2 3\n4 5 6\n", "PTS"),
        ("cloud.pts", b"3\n1 2 3\n4 5 6\n", "3 points.* 2 "),
        ("cloud.xyzrgb", b"1 2 3 255 0 0\n1 2 3 9 9 9\n", " 0 to 255"),
        ("cloud.stl", b"1 2 3\n", r"\.pcd, \.ply"),
        ("cloud", b"1 2 3\n", r"\.pcd, \.ply"),
    ],
)
def test_what_is_no_cloud_is_refused_with_the_file(
    tmp_path: Path, name: str, content: bytes, value: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(TacpipeError, match=value) as raised:
        read(path)
    assert str(path) in str(raised.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "cloud.pts"])
def test_points_that_are_not_finite_are_counted_and_nothing_is_dropped(tmp_path: Path, name: str) -> None:
    points = points_m()
    points[[5, 9]] = np.nan
    with pytest.raises(TacpipeError, match="2 of 50 points"):
        read(write(tmp_path / name, points))


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.pcd", "cloud.xyz"])
def test_a_cloud_of_many_metres_looks_like_millimetres(tmp_path: Path, name: str) -> None:
    with pytest.raises(TacpipeError, match=r" 9\d(\.\d+)? m .* millimetres"):
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
    with pytest.raises(TacpipeError, match=r"cloud\.ply.* 3 to 2 "):
        read(path)


def test_a_file_or_folder_that_is_no_file_is_told(tmp_path: Path) -> None:
    for suffix in SUFFIXES:
        with pytest.raises(TacpipeError, match=rf"cloud{suffix}"):
            read(str(tmp_path / f"cloud{suffix}"))
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(TacpipeError, match=r"folder\.ply"):
        read(tmp_path / "folder.ply")
