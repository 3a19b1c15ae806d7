"""The channels that recordings have in common: their column names, types, units and layout, as arrow fields.

The formats of published sets and the simulated rig build their tables here, so that what comes after them finds the
same names. pyarrow is imported when a table is made: a rig PC names formats without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa

TAXELS = 16  # of a XELA uSkin 4x4, numbered row by row
AXES = ("x", "y", "z")
COMPONENTS = ("x", "y", "z", "w")


def time_field(made: str | None = None) -> pa.Field:
    """Return the field ``t_ns``, int64 nanoseconds; ``made`` says how stamps came about that no clock gave."""
    import pyarrow as pa

    metadata = {"unit": "ns", "quantity": "time", **({"made": made} if made else {})}
    return pa.field("t_ns", pa.int64(), metadata=metadata)


def uskin_fields(taxels: int = TAXELS) -> list[pa.Field]:
    """Return the fields ``taxel01_x`` to ``taxel16_z`` of a XELA uSkin, uint16 device counts, taxel by taxel."""
    import pyarrow as pa

    return [
        pa.field(
            f"taxel{taxel:02d}_{axis}",
            pa.uint16(),
            metadata={"unit": "count", "quantity": "tactile", "taxel": str(taxel), "axis": axis},
        )
        for taxel in range(1, taxels + 1)
        for axis in AXES
    ]


def joint_fields(joints: int = 7) -> tuple[list[pa.Field], list[pa.Field]]:
    """Return the fields ``joint1_rad``, … and ``joint1_velocity_rad_s``, …, float64."""
    angles = [float_field(f"joint{n}_rad", "rad", "joint_position") for n in range(1, joints + 1)]
    speeds = [float_field(f"joint{n}_velocity_rad_s", "rad/s", "joint_velocity") for n in range(1, joints + 1)]
    return angles, speeds


def pose_fields() -> list[pa.Field]:
    """Return the seven float64 fields of a pose: ``position_x_m``, … z and the quaternion ``orientation_x``, … w."""
    position = [float_field(f"position_{axis}_m", "m", "position", axis) for axis in AXES]
    return position + [float_field(f"orientation_{part}", "1", "orientation", part) for part in COMPONENTS]


def float_field(name: str, unit: str, quantity: str, component: str | None = None) -> pa.Field:
    """Return a float64 field with its unit and quantity."""
    import pyarrow as pa

    metadata = {"unit": unit, "quantity": quantity, **({"component": component} if component else {})}
    return pa.field(name, pa.float64(), metadata=metadata)


def label_field(name: str) -> pa.Field:
    """Return an int8 field that holds a label, 0 or 1."""
    import pyarrow as pa

    return pa.field(name, pa.int8(), metadata={"unit": "1", "quantity": "label"})


def stream(
    t_ns: NDArray[np.int64], columns: Iterable[Any], fields: Sequence[pa.Field], made: str | None = None
) -> pa.Table:
    """Return the table of a stream: ``t_ns`` (time,) and one column a field, each (time,), cast to the field's type."""
    import pyarrow as pa

    arrays = [pa.array(t_ns, pa.int64())]
    arrays += [
        pa.array(np.ascontiguousarray(column, dtype=field.type.to_pandas_dtype()))
        for column, field in zip(columns, fields, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=pa.schema([time_field(made), *fields]))
