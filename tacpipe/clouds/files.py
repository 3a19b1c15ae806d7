"""Read cloud files: PLY, PCD, and points as text lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import Cloud, open3d
from tacpipe.errors import TacpipeError
from tacpipe.io import regular

TEXT = (".pts", ".xyz", ".xyzn", ".xyzrgb")  # one point per line
SUFFIXES = (".pcd", ".ply", *TEXT)
MAX_DIGITS = 18  # maximum number of digits of a point count
MAX_DISTANCE_M = 10.0  # maximum range of a hand's camera; a cloud in millimetres is a thousand times as large


def read(path: Path | str) -> Cloud:
    """Return the cloud of a file, in metres, with colours if it has any. The suffix determines the format.

    Raises `TacpipeError` with the path if the file is missing, not a cloud, empty or cut off, contains points that are
    not finite, or is so large that it cannot be in metres.
    """
    file = Path(path)
    if file.suffix.lower() not in SUFFIXES:
        raise TacpipeError(f"{file} is not a supported cloud; its suffix must be one of {', '.join(SUFFIXES)}.")
    if not file.exists() or file.is_dir():
        raise TacpipeError(f"{file} does not exist; give a point cloud file.")
    regular.require(file, file.stat().st_mode)
    if not file.stat().st_size:
        raise TacpipeError(f"{file} is empty. Copy it again from its source.")
    cloud = READERS.get(file.suffix.lower(), _read_text)(file)
    require_metres(file, cloud)
    return cloud


def require_metres(path: Path, cloud: Cloud) -> None:
    """Raise `TacpipeError` if a cloud is larger than `MAX_DISTANCE_M`."""
    extent_m = float(np.ptp(cloud.points_m.astype(np.float64), axis=0).max(initial=0.0))
    if extent_m > MAX_DISTANCE_M:
        raise TacpipeError(
            f"{path} is {extent_m:.4g} m long; clouds have at most {MAX_DISTANCE_M:g} m. If it is in millimetres, divide "
            f"its coordinates by 1000."
        )


def _read_pcd(path: Path) -> Cloud:
    """Return the cloud of a PCD file; open3d reads only compressed ones. Raises `TacpipeError` as `read` does."""
    content = regular.content(path)
    header = point_files.read_header(path, content)
    if header.data != "binary_compressed":
        return point_files.read(path)
    point_files.require_compressed_size(path, content, header)  # open3d allocates the memory that the file declares
    return _read_with_open3d(path, header.points)


def _read_ply(path: Path) -> Cloud:
    """Return the cloud of a PLY file. Raises `TacpipeError` as `read` does.

    open3d is not used: a crafted header makes its parser write out of bounds.
    """
    xyz, colours = point_files.parse_ply(path, regular.content(path))
    _require_finite(path, xyz)
    return Cloud(xyz, colours)


READERS = {".pcd": _read_pcd, ".ply": _read_ply}


def _read_text(path: Path) -> Cloud:
    return _read_with_open3d(path, _declared_points(path))


def _declared_points(path: Path) -> int:
    """Return the number of points that a text file declares in its first line, or its number of lines.

    Raises `TacpipeError` for a PTS file that declares no number, or more points than it contains.
    """
    lines = path.read_bytes().splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.startswith(b"#")]
    if path.suffix.lower() != ".pts":
        return len(rows)
    if not rows or len(rows[0]) != 1 or not rows[0][0].isdigit() or len(rows[0][0]) > MAX_DIGITS:
        raise TacpipeError(f"{path} is not a PTS file: its first line must be the number of points.")
    declared = int(rows[0][0])
    available = _pts_row_count(path)
    if available < declared:  # open3d allocates memory for the declared number
        raise TacpipeError(
            f"{path} declares {declared} points, but {available} can be read: it was cut off. Copy it again from its source."
        )
    return declared


def _read_with_open3d(path: Path, declared: int) -> Cloud:
    """Return the cloud that open3d reads.

    Raises `TacpipeError` if it does not have the declared number of finite points.

    Colours outside 0 to 1 are an error, too.
    """
    with open3d() as library:
        cloud = library.io.read_point_cloud(str(path), format=path.suffix.lower()[1:])
        with np.errstate(over="ignore"):  # values beyond float32 become infinite
            points = np.asarray(cloud.points).astype(np.float32)  # (point, xyz)
        colours = np.asarray(cloud.colors)  # (point, rgb) from 0 to 1
    count = _pts_row_count(path) if path.suffix.lower() == ".pts" else len(points)
    if min(count, len(points)) != declared or not declared:
        raise TacpipeError(
            f"{path} declares {declared} points, but {min(count, len(points))} can be read: it was cut off, or some are not "
            f"numbers. Copy it again from its source."
        )
    _require_finite(path, points)
    if not cloud.has_colors():
        return Cloud(points)
    if not (colours.min() >= 0 and colours.max() <= 1):
        raise TacpipeError(
            f"{path} has colours from {colours.min():g} to {colours.max():g}; this format has fractions from 0 to 1. "
            f"Divide them by 255."
        )
    return Cloud(points, np.rint(colours * 255).astype(np.uint8))


def _require_finite(path: Path, points: AnyArray) -> None:
    """Raise `TacpipeError` if some of the points (point, xyz) are not finite."""
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise TacpipeError(
            f"{path} contains {np.count_nonzero(~finite)} of {len(points)} points that are not finite (NaN), the first "
            f"being point {int(np.argmin(finite))}. Remove them and save the cloud again."
        )


def _pts_row_count(path: Path) -> int:
    """Return the number of points that follow the first line of a PTS file; open3d invents missing points."""
    return sum(1 for line in path.read_bytes().splitlines()[1:] if len(line.split()) >= 3)
