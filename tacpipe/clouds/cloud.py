"""A cloud of points in metres, with colours where the camera saw them, and the table that holds one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Bytes, Float32s
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

POSITION = ("x_m", "y_m", "z_m")
COLOUR = ("red", "green", "blue")


@dataclass(frozen=True)
class Cloud:
    """Points in the camera's frame; raises `TacpipeError` where one is not finite."""

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

        Raises `TacpipeError` where a coordinate's column is missing.
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
    there = set(table.column_names)  # which the table lists anew each time that it is asked
    missing = [name for name in names if name not in there]
    if missing:
        raise TacpipeError(f"The column {missing[0]} is missing. Ingest or segment the recording again.")
