"""The taxels of a sensor over time: where they lie, and how far each is from its level without load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import components, places
from tacpipe.signals.contact import rest_level
from tacpipe.traces.curves import TIME, described, matrix

if TYPE_CHECKING:
    import pyarrow as pa

REST_S = 0.2  # at the start, whose median is the level without load where no segmentation gave it
LARGEST = 0.995  # quantile that is the end of a scale: a single wrong reading would darken all others
LEAST = 0.5  # of a unit, the smallest end of a scale


@dataclass(frozen=True)
class Taxels:
    """One finger's taxels; readings that are a single row are kept as they are, since their rest is unknown."""

    stream: str
    finger: str  # of several on one stream, else empty
    unit: str
    names: tuple[str, ...]  # of the taxels
    channels: tuple[str, ...]  # the columns, taxel by taxel
    places: Floats  # (taxel, 2), to the right and up
    places_unit: str  # mm, or grid
    t_ns: Times  # (time,)
    change: Floats  # (time, taxel, axis) from rest; three axes x, y, z or one
    rest: Floats  # (channel,), taken off

    @property
    def name(self) -> str:
        """The stream, and the finger where it has several."""
        return f"{self.stream} {self.finger}".strip()

    @property
    def magnitude(self) -> Floats:
        """How far each taxel is from rest (time, taxel): the length of its vector, or the change with its sign."""
        if self.change.shape[2] == 1:
            return self.change[:, :, 0]
        return np.asarray(np.sqrt(np.einsum("tna,tna->tn", self.change, self.change)))

    @property
    def load(self) -> Floats:
        """The mean distance of the taxels from rest (time,), as `tacpipe segment contacts` thresholds it."""
        return np.asarray(np.abs(self.magnitude).mean(axis=1))


def of_streams(streams: Mapping[str, pa.Table]) -> list[Taxels]:
    """Return the taxels of all streams, a finger at a time."""
    return [taxels for stream, table in streams.items() for taxels in of_table(stream, table)]


def of_table(stream: str, table: pa.Table) -> list[Taxels]:
    """Return the taxels of a stream's tactile columns, a finger at a time; none of a stream without times.

    The level without load is that of the field metadata (``rest``, of `tacpipe segment contacts`), else the median of the
    first 0.2 s.
    """
    if TIME not in table.column_names or not table.num_rows:
        return []
    fingers: dict[str, list[pa.Field]] = {}
    for field in table.schema:
        about = described(field)
        if about.get("quantity") == "tactile":
            fingers.setdefault(about.get("finger", ""), []).append(field)
    return [_of_fields(stream, finger, table, fields) for finger, fields in fingers.items()]


def _of_fields(stream: str, finger: str, table: pa.Table, fields: Sequence[pa.Field]) -> Taxels:
    fields, axes = _by_taxel(fields)
    columns = [field.name for field in fields]
    t_ns, values = table.column(TIME).to_numpy(), matrix(table, columns)
    firsts = fields[::axes]
    place, unit = places.of_taxels(firsts)
    rest = _rest(fields, values, t_ns)
    names = tuple(one.name.rpartition("_")[0] if axes == 3 else one.name for one in firsts)
    if finger:
        names = tuple(name.removeprefix(f"{finger}_") for name in names)
    return Taxels(
        stream,
        finger,
        described(firsts[0]).get("unit", ""),
        names,
        tuple(columns),
        place,
        unit,
        t_ns,
        (values - rest).reshape(len(t_ns), -1, axes),
        rest,
    )


def _rest(fields: Sequence[pa.Field], values: Floats, t_ns: Times) -> Floats:
    known = [described(field).get("rest") for field in fields]
    if all(one is not None for one in known):
        return np.array([float(one or 0) for one in known])
    return np.zeros(len(fields)) if len(t_ns) < 2 else rest_level(values, t_ns, REST_S)


def _by_taxel(fields: Sequence[pa.Field]) -> tuple[list[pa.Field], int]:
    """Return the columns ordered taxel by taxel, x, y, z of each, and 3; as they are, and 1, where they are no vectors."""
    vectors: dict[str, dict[str, pa.Field]] = {}
    for field in fields:
        about = described(field)
        axis = about.get("axis", "")
        part, shared = (axis, field.name.removesuffix(axis)) if axis else components.of_name(field.name)
        vectors.setdefault(shared, {})[part] = field
    if vectors and all(set(one) == set("xyz") for one in vectors.values()):
        return [one[axis] for one in vectors.values() for axis in "xyz"], 3
    return list(fields), 1


def scale(values: Floats) -> tuple[float, float]:
    """Return the ends of a colour scale of ``values``: 0 and the 99.5 % quantile, or both signs where there are two.

    Values that never come near 0, as raw readings, get the ends that they have.

    >>> scale(np.array([0.0, 4.0])), scale(np.array([-4.0, 2.0])), scale(np.array([3000.0, 3500.0]))
    ((0.0, 3.98), (-3.99, 3.99), (3000.0, 3500.0))
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if low > 0.2 * high > 0:
        return low, high
    most = max(float(np.quantile(np.abs(finite), LARGEST)), LEAST)
    return (-most, most) if float(np.quantile(finite, 1 - LARGEST)) < -0.1 * most else (0.0, most)
