"""Define point clouds, their tables and text lines, depth images, and surface normals."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bytes, Counts, Float32s, Floats
from tacpipe.errors import TacpipeError
from tacpipe.plugins import extras
from tacpipe.printable import plain

POSITION = ("x_m", "y_m", "z_m")
COLOUR = ("red", "green", "blue")


@dataclass(frozen=True)
class Cloud:
    """Points in the camera's frame. Raises `TacpipeError` if the shapes are wrong or a point is not finite."""

    points_m: Float32s  # (point, xyz), metres
    colours: Bytes | None = None  # (point, rgb), 0 to 255

    def __post_init__(self) -> None:
        """Check the arrays. Raises `TacpipeError` if their shapes do not match or points are not finite."""
        if self.points_m.ndim != 2 or self.points_m.shape[1] != 3:
            raise TacpipeError(f"Points have the shape {self.points_m.shape}; they must be (point, xyz).")
        if self.colours is not None and self.colours.shape != self.points_m.shape:
            raise TacpipeError(
                f"Colours have the shape {self.colours.shape} and points {self.points_m.shape}; each point has "
                f"one colour (red, green, blue)."
            )
        finite = np.asarray(np.isfinite(self.points_m).all(axis=1))
        if not finite.all():
            raise TacpipeError(
                f"{np.count_nonzero(~finite)} of {len(finite)} points are not finite, the first being point "
                f"{int(np.argmin(finite))}. Leave such points out of the cloud."
            )

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points_m)

    @classmethod
    def from_table(cls, table: pa.Table) -> Cloud:
        """Return the cloud in a table with one row per point, with colours if all three columns exist.

        Raises `TacpipeError` if a coordinate's column is missing.
        """
        require_columns(table, POSITION)
        points = np.column_stack([table.column(name).to_numpy() for name in POSITION]).astype(np.float32, copy=False)
        if not set(COLOUR) <= set(table.column_names):
            return cls(points)
        return cls(points, np.column_stack([table.column(name).to_numpy() for name in COLOUR]))

    def table(self) -> pa.Table:
        """Return one row per point: ``x_m``, ``y_m``, ``z_m`` float32 and, with colours, ``red`` … ``blue`` uint8."""
        position = {"unit": "m", "quantity": "position"}
        fields = [pa.field(name, pa.float32(), metadata={**position, "component": name[0]}) for name in POSITION]
        values = list(self.points_m.T)
        if self.colours is not None:
            colour = {"unit": "count", "quantity": "colour"}
            fields += [pa.field(name, pa.uint8(), metadata={**colour, "component": name}) for name in COLOUR]
            values += list(self.colours.T)
        arrays = [
            pa.array(np.ascontiguousarray(column), field.type) for column, field in zip(values, fields, strict=True)
        ]
        return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def require_columns(table: pa.Table, names: Sequence[str]) -> None:
    """Raise `TacpipeError` with the first of ``names`` that is not a column of the table."""
    columns = set(table.column_names)  # a set, because the table creates the list of names at each access
    missing = [name for name in names if name not in columns]
    if missing:
        raise TacpipeError(f"The column {missing[0]} is missing. Ingest or segment the recording again.")


def nonblank_lines(body: bytes) -> list[str]:
    """Return the lines that are not blank."""
    return [line.decode("latin-1") for line in body.splitlines() if not line.isspace() and line]


def parse_points(
    path: Path, lines: Sequence[str], point: np.dtype[np.void], field_names: Collection[str]
) -> NDArray[np.void]:
    """Parse lines of numbers, one point per line, and return the points (point,); fields not in ``field_names`` are 0.

    Raises `TacpipeError` with the path if a line has another number of values than ``point``, or a value is out of the
    field's range.
    """
    names = point.names or ()
    edges = np.cumsum([0, *(int(np.prod(point[name].shape)) for name in names)])
    try:
        numbers = np.loadtxt(lines, np.float64, comments=None, ndmin=2)  # (point, number)
    except ValueError as error:
        raise TacpipeError(
            f"{path} has lines that are not {edges[-1]} numbers each: {plain(str(error).partition(';')[0], 120)}. Copy the "
            f"file again."
        ) from error
    if numbers.shape[1] != edges[-1]:
        raise TacpipeError(
            f"{path} has lines of {numbers.shape[1]} numbers; each point has {edges[-1]}. Copy the file again."
        )
    points = np.zeros(len(numbers), point)
    for name, start in zip(names, edges, strict=False):
        if name in field_names:
            points[name] = _cast(path, name, numbers[:, start], point[name])
    return points


def _cast(path: Path, name: str, column: Floats, kind: np.dtype[Any]) -> AnyArray:
    """Return a column (point,) in the type of its field; values beyond a float's range become infinite.

    Raises `TacpipeError` for integers that are out of range or not whole.
    """
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        wrong = ~((column >= limits.min) & (column <= limits.max) & (column == np.rint(column)))
        if wrong.any():
            point = int(np.argmax(wrong))
            raise TacpipeError(
                f"{path}, point {point}: {name} is {column[point]:g}; it must be a whole number from {limits.min} to "
                f"{limits.max}. Copy the file again."
            )
    with np.errstate(over="ignore"):
        return column.astype(kind)


@contextmanager
def open3d() -> Iterator[Any]:
    """Yield the module open3d, which prints only errors meanwhile. Raises `MissingModuleError` if it is not installed."""
    with extras.explain_missing("A cloud of points"):
        import open3d as module
    with module.utility.VerbosityContextManager(module.utility.VerbosityLevel.Error):
        yield module


RADIUS_M = 0.015  # of radii from 10 to 30 mm, that at which the published grasps are closest to the surface normals
CAMERA_M = (0.0, 0.0, 0.0)  # the camera is at the origin of its own frame


def normals(cloud: Cloud, radius_m: float = RADIUS_M, camera_m: Sequence[float] = CAMERA_M) -> Floats:
    """Return the unit normals (point, xyz) of a cloud's surface, pointing towards the camera.

    A normal is the direction in which the neighbours within ``radius_m`` spread least; with fewer than two neighbours
    it has no meaning. Raises `TacpipeError` if open3d is not installed.
    """
    camera = np.asarray(camera_m, np.float64)
    with open3d() as library:
        open3d_cloud = library.geometry.PointCloud(library.utility.Vector3dVector(cloud.points_m.astype(np.float64)))
        search = library.geometry.KDTreeSearchParamRadius(radius_m)
        open3d_cloud.estimate_normals(search, fast_normal_computation=False)
        directions: Floats = np.array(open3d_cloud.normals)
    towards = camera - cloud.points_m  # (point, xyz)
    return np.where((directions * towards).sum(axis=1, keepdims=True) < 0, -directions, directions)


MAGIC = b"TPDF"
MIN_PIXELS, MAX_PIXELS = 1e-3, 1e7  # range of the focal length, and maximum offset of the image centre, in pixels
HEADER = struct.Struct("<4sHHBxxx5f")  # magic, width, height, whether colours follow; focal lengths, centre, unit


@dataclass(frozen=True)
class DepthFrame:
    """An undistorted depth image with the camera's optics."""

    depth: Counts  # (row, column), along the optical axis in units of ``unit_m``; 0: no measurement
    focal: tuple[float, float]  # focal lengths in pixels, along a row and along a column
    centre: tuple[float, float]  # the optical axis in the image: column, row
    unit_m: float  # metres per count of depth
    colours: Bytes | None = None  # (row, column, rgb)

    def points(self) -> tuple[Float32s, Bytes | None]:
        """Return the measured points (point, xyz), in metres, and their colours (point, rgb) or None.

        In the camera's frame: x to the right of the image, y down, z along the optical axis.
        """
        rows, columns = np.nonzero(self.depth)
        z = self.depth[rows, columns].astype(np.float64) * self.unit_m
        x = (columns - self.centre[0]) / self.focal[0] * z
        y = (rows - self.centre[1]) / self.focal[1] * z
        colours = None if self.colours is None else self.colours[rows, columns]
        return np.column_stack([x, y, z]).astype(np.float32), colours

    def to_bytes(self) -> bytes:
        """Return the frame as bytes: a header, depth as u16 little-endian, then colours."""
        height, width = self.depth.shape
        coloured = self.colours is not None
        head = HEADER.pack(MAGIC, width, height, coloured, *self.focal, *self.centre, self.unit_m)
        return head + self.depth.astype("<u2").tobytes() + (self.colours.tobytes() if self.colours is not None else b"")

    @classmethod
    def from_bytes(cls, content: bytes) -> DepthFrame:
        """Return the frame that `to_bytes` encoded. Raises `TacpipeError` if it is not a frame or was cut off."""
        if len(content) < HEADER.size or not content.startswith(MAGIC):
            raise TacpipeError(f"{len(content)} bytes are not a depth frame; it must begin with {MAGIC.decode()}.")
        _, width, height, has_colours, *optics = HEADER.unpack_from(content)
        pixels = width * height
        if len(content) != HEADER.size + pixels * (5 if has_colours else 2):
            raise TacpipeError(
                f"A depth frame of {width} x {height} pixels has {len(content)} bytes, so it is incomplete."
            )
        if not (
            all(MIN_PIXELS <= length <= MAX_PIXELS for length in optics[:2])
            and max(map(abs, optics[2:4])) <= MAX_PIXELS
        ):
            raise TacpipeError(f"A depth frame has the optics {optics[:4]}, in pixels, which no camera has.")
        if not 0 < optics[4] <= 1:
            raise TacpipeError(f"A depth frame has the unit {optics[4]:g} m; it must be above 0 and at most 1.")
        depth = np.frombuffer(content, "<u2", pixels, HEADER.size).reshape(height, width).astype(np.uint16)
        start = HEADER.size + 2 * pixels
        colours = np.frombuffer(content, np.uint8, 3 * pixels, start).reshape(height, width, 3) if has_colours else None
        return cls(depth, (optics[0], optics[1]), (optics[2], optics[3]), optics[4], colours)
