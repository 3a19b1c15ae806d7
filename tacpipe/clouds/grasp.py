"""Define a grasp by two fingers: the contact points on the object and the rotation of the wrist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.channels import schema as channels
from tacpipe.clouds.cloud import require_columns
from tacpipe.errors import TacpipeError

POINTS = tuple(f"{point}_{axis}_m" for point in ("g1", "g2") for axis in "xyz")
WRIST = tuple(f"wrist_{axis}_{component}" for axis in "xyz" for component in "xyz")
MAX_ROTATION_ERROR = 1e-3  # maximum error of a wrist's rotation matrix: the precision of files with five digits


@dataclass(frozen=True)
class Grasp:
    """Two contact points in the frame of their cloud and, if recorded, the wrist's rotation.

    Raises `TacpipeError` if a value is not finite, both points are equal, or the wrist is not a rotation.
    """

    g1_m: Floats  # (xyz), metres
    g2_m: Floats  # (xyz), metres
    # (component, axis): the columns are the approach, closing and third axes in the cloud's frame
    wrist: Floats | None = None

    def __post_init__(self) -> None:
        """Check the points and the wrist. Raises `TacpipeError` if they are not finite, equal, or not a rotation."""
        if not (np.isfinite(self.g1_m).all() and np.isfinite(self.g2_m).all()):
            raise TacpipeError(f"The grasp points are {self.g1_m} and {self.g2_m}; both must be finite, in metres.")
        if self.opening_m == 0:
            raise TacpipeError(f"Both grasp points are {self.g1_m}; the fingers must touch at two different points.")
        if self.wrist is not None:
            if self.wrist.shape != (3, 3) or not np.isfinite(self.wrist).all():
                raise TacpipeError("The wrist's rotation must be nine finite numbers.")
            error = np.abs(self.wrist.T @ self.wrist - np.eye(3)).max()
            if error > MAX_ROTATION_ERROR or np.linalg.det(self.wrist) < 0:
                raise TacpipeError(
                    f"The wrist's axes deviate from a rotation by {error:.3g}, with determinant "
                    f"{np.linalg.det(self.wrist):.3g}; they must be three right-handed unit vectors at right angles."
                )

    @property
    def opening_m(self) -> float:
        """The distance between the fingers, in metres."""
        return float(np.linalg.norm(self.g2_m - self.g1_m))

    @property
    def middle_m(self) -> Floats:
        """The point between the fingers (xyz), metres."""
        return (self.g1_m + self.g2_m) / 2

    @property
    def closing(self) -> Floats:
        """The unit vector from g1 to g2 (xyz)."""
        return (self.g2_m - self.g1_m) / self.opening_m

    @property
    def swapped(self) -> Grasp:
        """The same grasp with the fingers exchanged: half a turn about the wrist's approach axis."""
        wrist = None if self.wrist is None else self.wrist * (1.0, -1.0, -1.0)
        return Grasp(self.g2_m, self.g1_m, wrist)

    def moved(self, rotation: Floats, shift_m: Floats) -> Grasp:
        """Return the grasp rotated by ``rotation`` (3, 3) and then shifted, as its cloud would be."""
        wrist = None if self.wrist is None else rotation @ self.wrist
        return Grasp(rotation @ self.g1_m + shift_m, rotation @ self.g2_m + shift_m, wrist)

    @classmethod
    def from_table(cls, table: pa.Table) -> Grasp:
        """Return the grasp in a table of one row.

        Raises `TacpipeError` if the table does not have one row, or a column of the points is missing.
        """
        require_columns(table, POINTS)
        if table.num_rows != 1:
            raise TacpipeError(f"A grasp's table has {table.num_rows} rows; it must have one.")
        points = np.array([table.column(name)[0].as_py() for name in POINTS], float)
        wrist = None
        if set(WRIST) <= set(table.column_names):
            wrist = np.array([table.column(name)[0].as_py() for name in WRIST], float).reshape(3, 3).T
        return cls(points[:3], points[3:], wrist)

    def table(self, t_ns: int) -> pa.Table:
        """Return a table of one row: ``t_ns``, ``g1_x_m`` … ``g2_z_m``, and ``wrist_x_x`` … if there is a wrist.

        ``wrist_x_y`` is the component along y of the wrist's first axis.
        """
        fields = [channels.float_field(name, "m", "position", name[3]) for name in POINTS]
        values = [*self.g1_m, *self.g2_m]
        if self.wrist is not None:
            fields += [channels.float_field(name, "1", "orientation", name[-1]) for name in WRIST]
            values += list(self.wrist.T.ravel())
        schema = pa.schema([channels.time_field(), *fields])
        arrays = [pa.array([t_ns], pa.int64()), *(pa.array([float(value)], pa.float64()) for value in values)]
        return pa.Table.from_arrays(arrays, schema=schema)


MAX_ALIGNMENT = 0.999  # cosine between closing axis and line of sight above which another approach is used


def estimate_wrist(grasp: Grasp) -> Floats:
    """Return axes (component, axis) for a grasp without a wrist: approach along the line of sight, closing, and third.

    The camera, at the origin, looks down on the object as the hand approaches it. The approach axis is the line of
    sight to the middle of the grasp, made perpendicular to the closing axis. If that is zero, because the fingers close
    along the line of sight or around the camera, the frame's axis that is most perpendicular to closing is used.
    """
    sight = grasp.middle_m / max(float(np.linalg.norm(grasp.middle_m)), 1e-12)
    if not sight.any() or abs(sight @ grasp.closing) > MAX_ALIGNMENT:
        sight = np.eye(3)[np.argmin(np.abs(grasp.closing))]
    return axes(sight, grasp.closing)


def axes(approach: Floats, closing: Floats) -> Floats:
    """Return right-handed axes (component, axis): ``approach`` made perpendicular, ``closing``, and their product.

    ``closing`` must be a unit vector, and ``approach`` not parallel to it.
    """
    perpendicular = approach - (approach @ closing) * closing
    perpendicular = perpendicular / np.linalg.norm(perpendicular)
    return np.column_stack([perpendicular, closing, np.cross(perpendicular, closing)])


def wrist_axes(grasp: Grasp) -> Floats:
    """Return the axes of a grasp (component, axis): approach, closing, third. The approach is the wrist's if it has one.

    The closing axis is that from g1 to g2, whatever the wrist's second axis is. If the wrist's first axis is parallel
    to it, its second axis is used as the approach, so that the axes still rotate with the wrist.
    """
    if grasp.wrist is None:
        return estimate_wrist(grasp)
    approach = grasp.wrist[:, 0]
    if abs(approach @ grasp.closing) > MAX_ALIGNMENT:
        approach = grasp.wrist[:, 1]
    return axes(approach, grasp.closing)


def local_points(points_m: AnyFloats, grasp: Grasp) -> Floats:
    """Return points (point, axis) in the axes of the grasp, relative to the middle between the fingers, in metres.

    g1 is at (0, -opening / 2, 0), g2 at (0, opening / 2, 0).
    """
    return (points_m - grasp.middle_m) @ wrist_axes(grasp)
