"""Ways through space: positions with three components of a stream, and the orientation beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import arm
from tacpipe.channels.arm import METRES, ORIENTATION, POSITION
from tacpipe.traces.curves import TIME, described, matrix

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Path:
    """A path in metres, without the rows whose position is not finite."""

    name: str
    t_ns: Times  # (time,)
    position_m: Floats  # (time, xyz)
    quaternion: Floats | None = None  # (time, xyzw), where the stream has one orientation


def of_streams(streams: Mapping[str, pa.Table]) -> list[Path]:
    """Return the paths of all streams whose rows are moments, but not of clouds, whose rows are points."""
    return [path for stream, table in streams.items() for path in of_table(stream, table)]


def of_table(stream: str, table: pa.Table) -> list[Path]:
    """Return the paths of a stream: one for each position in m, cm or mm with the components x, y and z."""
    if TIME not in table.column_names or not table.num_rows:
        return []
    t_ns = table.column(TIME).to_numpy()
    if 2 * len(np.unique(t_ns)) < len(t_ns):  # a cloud's points share a stamp
        return []
    positions = _vectors(table, POSITION, "xyz")
    turned = _vectors(table, ORIENTATION, "xyzw")
    quaternion = matrix(table, [field.name for field in next(iter(turned.values()))]) if len(turned) == 1 else None
    paths = []
    for shared, fields in positions.items():
        scale = [METRES.get(described(field).get("unit", "m")) for field in fields]
        if None in scale:
            continue
        place_m = matrix(table, [field.name for field in fields]) * np.array(scale, dtype=np.float64)
        valid = np.isfinite(place_m).all(axis=1)
        if quaternion is not None:
            valid &= np.isfinite(quaternion).all(axis=1) & (np.abs(quaternion).sum(axis=1) > 0)
        if valid.any():
            part = f"{stream} {shared.split('_')[0]}".strip() if len(positions) > 1 else stream or "position"
            paths.append(Path(part, t_ns[valid], place_m[valid], None if quaternion is None else quaternion[valid]))
    return paths


def _vectors(table: pa.Table, quantity: str, parts: str) -> dict[str, list[pa.Field]]:
    """Return the columns of each vector of a quantity that has all of ``parts``, in their order."""
    by_name: dict[str, dict[str, pa.Field]] = {}
    for field in table.schema:
        if described(field).get("quantity") == quantity:
            shared = arm.of_name(field.name)[1]
            by_name.setdefault(shared, {})[arm.component(field)] = field
    return {
        name: [fields_by_part[part] for part in parts]
        for name, fields_by_part in by_name.items()
        if set(fields_by_part) == set(parts)
    }
