"""Files of clouds as users have them: PLY, PCD, and points as lines of text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.clouds.cloud import Cloud, open3d
from tacpipe.errors import TacpipeError
from tacpipe.io import regular

TEXT = (".pts", ".xyz", ".xyzn", ".xyzrgb")  # a line a point
SUFFIXES = (".pcd", ".ply", *TEXT)
DIGITS = 18  # largest number of digits of a number of points
MAX_DISTANCE_M = 10.0  # largest distance that a hand's camera sees; a cloud in millimetres is a thousand times as large


def read(path: Path | str) -> Cloud:
    """Return the cloud of a file, in metres, with colours where it has any; its ending states the format.

    Raises `TacpipeError`, naming the file, where it is missing, no cloud, empty or cut off, where points are not finite, and
    where the cloud is so large that its unit must be another one.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise TacpipeError(f"{path} is not a cloud that can be read; it must end in one of {', '.join(SUFFIXES)}.")
    if not path.exists() or path.is_dir():
        raise TacpipeError(f"There is no file {path}; give the file of a cloud of points.")
    regular.require(path, path.stat().st_mode)
    if not path.stat().st_size:
        raise TacpipeError(f"{path} is empty. Copy it again from its source.")
    cloud = READERS.get(path.suffix.lower(), _text)(path)
    require_metres(path, cloud)
    return cloud


def require_metres(path: Path, cloud: Cloud) -> None:
    """Raise `TacpipeError` if a cloud is larger than `MAX_DISTANCE_M`."""
    extent_m = float(np.ptp(cloud.points_m.astype(np.float64), axis=0).max(initial=0.0))
    if extent_m > MAX_DISTANCE_M:
        raise TacpipeError(
            f"{path} is {extent_m:.4g} m long; clouds have at most {MAX_DISTANCE_M:g} m. If it is in millimetres, divide "
            f"its coordinates by 1000."
        )


def _pcd(path: Path) -> Cloud:
    from tacpipe.clouds import point_files

    content = regular.content(path)
    header = point_files.read_header(path, content)
    if header.data != "binary_compressed":
        return point_files.read(path)
    point_files.require_compressed(path, content, header)  # open3d takes the memory that the file declares
    return _by_open3d(path, header.points)


def _ply(path: Path) -> Cloud:
    """Return the cloud of a PLY file; open3d's parser writes beyond its memory where a header is made to have it do so."""
    from tacpipe.clouds import point_files

    xyz, colours = point_files.parse_ply(path, regular.content(path))
    _require_finite(path, xyz)
    return Cloud(xyz, colours)


READERS = {".pcd": _pcd, ".ply": _ply}


def _text(path: Path) -> Cloud:
    return _by_open3d(path, _declared_points(path))


def _declared_points(path: Path) -> int:
    """Return how many points a file of text declares: its first line, or its lines."""
    lines = path.read_bytes().splitlines()
    filled = [line.split() for line in lines if line.strip() and not line.startswith(b"#")]
    if path.suffix.lower() != ".pts":
        return len(filled)
    if not filled or len(filled[0]) != 1 or not filled[0][0].isdigit() or len(filled[0][0]) > DIGITS:
        raise TacpipeError(f"{path} is not a PTS file: its first line must hold only the number of points.")
    declared = int(filled[0][0])
    if _rows(path) < declared:  # open3d takes memory for as many as are declared
        raise TacpipeError(
            f"{path} declares {declared} points, and {_rows(path)} can be read: it was cut off. Copy it again from its "
            f"source."
        )
    return declared


def _by_open3d(path: Path, declared: int) -> Cloud:
    """Return the cloud that open3d reads, if it is what the file declares."""
    with open3d() as library:
        cloud = library.io.read_point_cloud(str(path), format=path.suffix.lower()[1:])
        with np.errstate(over="ignore"):  # values beyond float32 become infinite
            points = np.asarray(cloud.points).astype(np.float32)  # (point, xyz)
        colours = np.asarray(cloud.colors)  # (point, rgb) from 0 to 1
    count = _rows(path) if path.suffix.lower() == ".pts" else len(points)
    if min(count, len(points)) != declared or not declared:
        raise TacpipeError(
            f"{path} declares {declared} points, and {min(count, len(points))} can be read: it was cut off, or some are not "
            f"numbers. Copy it again from its source."
        )
    _require_finite(path, points)
    if not cloud.has_colors():
        return Cloud(points)
    if not (colours.min() >= 0 and colours.max() <= 1):
        raise TacpipeError(
            f"{path} has colours from {colours.min():g} to {colours.max():g}; in its format they are shares from 0 to 1. "
            f"Divide them by 255."
        )
    return Cloud(points, np.rint(colours * 255).astype(np.uint8))


def _require_finite(path: Path, points: AnyArray) -> None:
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise TacpipeError(
            f"{path} holds {np.count_nonzero(~finite)} of {len(points)} points that are not finite (NaN), the first being "
            f"point {int(np.argmin(finite))}. Remove them and save the cloud again."
        )


def _rows(path: Path) -> int:
    """Return how many points follow the number of a PTS file; open3d makes up those that are missing."""
    return sum(1 for line in path.read_bytes().splitlines()[1:] if len(line.split()) >= 3)
