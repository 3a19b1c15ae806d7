"""Define clouds of points, their tables and texts, the images of depth cameras, and surface normals."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bytes, Counts, Float32s, Floats
from tacpipe.errors import TacpipeError
from tacpipe.plugins import extras
from tacpipe.printable import plain

if TYPE_CHECKING:
    import pyarrow as pa

POSITION = ("x_m", "y_m", "z_m")
COLOUR = ("red", "green", "blue")


@dataclass(frozen=True)
class Cloud:
    """Points in the camera's frame; raises `TacpipeError` if one is not finite."""

    points_m: Float32s  # (point, xyz), metres
    colours: Bytes | None = None  # (point, rgb), 0 to 255

    def __post_init__(self) -> None:
        """Refuse what is not a cloud."""
        if self.points_m.ndim != 2 or self.points_m.shape[1] != 3:
            raise TacpipeError(f"Points have the shape {self.points_m.shape}; a cloud's are (point, xyz).")
        if self.colours is not None and self.colours.shape != self.points_m.shape:
            raise TacpipeError(
                f"There are colours of the shape {self.colours.shape} and points of {self.points_m.shape}; each point has "
                f"one colour (red, green, blue)."
            )
        finite = np.asarray(np.isfinite(self.points_m).all(axis=1))
        if not finite.all():
            raise TacpipeError(
                f"{np.count_nonzero(~finite)} of {len(finite)} points are not finite, the first being point "
                f"{int(np.argmin(finite))}. Leave such points out of the cloud."
            )

    def __len__(self) -> int:
        """Return how many points there are."""
        return len(self.points_m)

    @classmethod
    def of(cls, table: pa.Table) -> Cloud:
        """Return the cloud that a table holds, one row a point, with colours if it has all three columns.

        Raises `TacpipeError` if a coordinate's column is missing.
        """
        require_columns(table, POSITION)
        points = np.column_stack([table.column(name).to_numpy() for name in POSITION]).astype(np.float32, copy=False)
        if not set(COLOUR) <= set(table.column_names):
            return cls(points)
        return cls(points, np.column_stack([table.column(name).to_numpy() for name in COLOUR]))

    def table(self) -> pa.Table:
        """Return one row a point: ``x_m``, ``y_m``, ``z_m`` float32 and, with colours, ``red`` … ``blue`` uint8."""
        import pyarrow as pa

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
    """Raise `TacpipeError` naming the first of ``names`` that is not a column of the table."""
    columns = set(table.column_names)  # the table builds this list at each access
    missing = [name for name in names if name not in columns]
    if missing:
        raise TacpipeError(f"The column {missing[0]} is missing. Ingest or segment the recording again.")


def filled(body: bytes) -> list[str]:
    """Return the lines that are not blank."""
    return [line.decode("latin-1") for line in body.splitlines() if not line.isspace() and line]


def parsed(
    path: Path, lines: Sequence[str], point: np.dtype[np.void], field_names: Collection[str]
) -> NDArray[np.void]:
    """Return the points (point,) of lines, one or more, each the numbers of one ``point``; other fields are 0.

    Raises `TacpipeError`, naming the file, where a line holds other than that many numbers, or a number that its field
    cannot have.
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
    for name, place in zip(names, edges, strict=False):
        if name in field_names:
            points[name] = _cast(path, name, numbers[:, place], point[name])
    return points


def _cast(path: Path, name: str, column: Floats, kind: np.dtype[Any]) -> AnyArray:
    """Return a column (point,) in the type of its field; what a float cannot hold becomes infinite."""
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
    """Yield the module open3d; within, it prints nothing but errors. Raises `MissingModuleError` without it."""
    with extras.explain_missing("A cloud of points"):
        import open3d as module
    with module.utility.VerbosityContextManager(module.utility.VerbosityLevel.Error):
        yield module


RADIUS_M = 0.015  # the radius from 10 to 30 mm at which the published grasps close most squarely on the surface
CAMERA_M = (0.0, 0.0, 0.0)  # a cloud in the camera's frame is seen from its origin


def normals(cloud: Cloud, radius_m: float = RADIUS_M, camera_m: Sequence[float] = CAMERA_M) -> Floats:
    """Return the unit normals (point, xyz) of the surface that a cloud was seen on, each turned towards the camera.

    A normal is the direction in which the neighbours within ``radius_m`` spread least; where there are fewer than two, it
    states nothing. Raises `TacpipeError` if open3d is not installed.
    """
    camera = np.asarray(camera_m, np.float64)
    with open3d() as library:
        open3d_cloud = library.geometry.PointCloud(library.utility.Vector3dVector(cloud.points_m.astype(np.float64)))
        around = library.geometry.KDTreeSearchParamRadius(radius_m)
        open3d_cloud.estimate_normals(around, fast_normal_computation=False)
        directions: Floats = np.array(open3d_cloud.normals)
    towards = camera - cloud.points_m  # (point, xyz)
    return np.where((directions * towards).sum(axis=1, keepdims=True) < 0, -directions, directions)


MAGIC = b"TPDF"
NEAREST, FARTHEST = 1e-3, 1e7  # least and largest focal length, and largest image centre, in pixels
HEADER = struct.Struct("<4sHHBxxx5f")  # magic, width, height, whether colours follow; focal lengths, centre, unit


@dataclass(frozen=True)
class DepthFrame:
    """A depth image without distortion, and where its pixels look."""

    depth: Counts  # (row, column), along the optical axis in units of ``unit_m``; 0: nothing was measured
    focal: tuple[float, float]  # focal lengths in pixels, along a row and along a column
    centre: tuple[float, float]  # the optical axis in the image: column, row
    unit_m: float  # metres a count of depth
    colours: Bytes | None = None  # (row, column, rgb)

    def points(self) -> tuple[Float32s, Bytes | None]:
        """Return the points that were measured (point, xyz), metres, and their colours (point, rgb).

        In the camera's frame: x to the right of the image, y down, z along the optical axis.
        """
        rows, columns = np.nonzero(self.depth)
        z = self.depth[rows, columns].astype(np.float64) * self.unit_m
        x = (columns - self.centre[0]) / self.focal[0] * z
        y = (rows - self.centre[1]) / self.focal[1] * z
        colours = None if self.colours is None else self.colours[rows, columns]
        return np.column_stack([x, y, z]).astype(np.float32), colours

    def to_bytes(self) -> bytes:
        """Return the frame as a link hands it on: a header, depth as u16 little-endian, colours as bytes."""
        height, width = self.depth.shape
        coloured = self.colours is not None
        head = HEADER.pack(MAGIC, width, height, coloured, *self.focal, *self.centre, self.unit_m)
        return head + self.depth.astype("<u2").tobytes() + (self.colours.tobytes() if self.colours is not None else b"")

    @classmethod
    def from_bytes(cls, content: bytes) -> DepthFrame:
        """Return the frame that `to_bytes` gave. Raises `TacpipeError` if it is none or was cut off."""
        if len(content) < HEADER.size or not content.startswith(MAGIC):
            raise TacpipeError(f"{len(content)} bytes are not a depth frame; it must begin with {MAGIC.decode()}.")
        _, width, height, coloured, *optics = HEADER.unpack_from(content)
        pixels = width * height
        if len(content) != HEADER.size + pixels * (5 if coloured else 2):
            raise TacpipeError(
                f"A depth frame of {width} x {height} pixels came with {len(content)} bytes, so it is incomplete."
            )
        if not (all(NEAREST <= length <= FARTHEST for length in optics[:2]) and max(map(abs, optics[2:4])) <= FARTHEST):
            raise TacpipeError(f"A depth frame has the optics {optics[:4]}, pixels; no camera has.")
        if not 0 < optics[4] <= 1:
            raise TacpipeError(
                f"A depth frame counts in units of {optics[4]:g} m; the unit must be above 0 and at most 1."
            )
        depth = np.frombuffer(content, "<u2", pixels, HEADER.size).reshape(height, width).astype(np.uint16)
        start = HEADER.size + 2 * pixels
        colours = np.frombuffer(content, np.uint8, 3 * pixels, start).reshape(height, width, 3) if coloured else None
        return cls(depth, (optics[0], optics[1]), (optics[2], optics[3]), optics[4], colours)
