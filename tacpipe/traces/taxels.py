"""Compute the taxels of a sensor over time: their places, their distance from rest, and an image of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import arm, places
from tacpipe.signals.contact import rest_level
from tacpipe.traces.curves import TIME, described, matrix

if TYPE_CHECKING:
    import pyarrow as pa

REST_S = 0.2  # time at the start whose median is the level without load, where no segmentation gave a level
SCALE_QUANTILE = 0.995  # quantile that is the end of a scale: a single wrong reading would darken all others
MIN_SCALE = 0.5  # smallest end of a scale, in the unit of the values


@dataclass(frozen=True)
class Taxels:
    """One finger's taxels; readings that are a single row are kept as they are, since their rest is unknown."""

    stream: str
    finger: str  # name of the finger where the stream has several, else empty
    unit: str
    names: tuple[str, ...]  # taxel names
    channels: tuple[str, ...]  # the columns, taxel by taxel
    places: Floats  # (taxel, 2), to the right and up
    places_unit: str  # mm, or grid
    t_ns: Times  # (time,)
    change: Floats  # (time, taxel, axis) from rest; three axes x, y, z or one
    rest_levels: Floats  # (channel,), subtracted

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
    place, unit = places.taxel_positions(firsts)
    levels = _rest_levels(fields, values, t_ns)
    names = tuple(field.name.rpartition("_")[0] if axes == 3 else field.name for field in firsts)
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
        (values - levels).reshape(len(t_ns), -1, axes),
        levels,
    )


def _rest_levels(fields: Sequence[pa.Field], values: Floats, t_ns: Times) -> Floats:
    stored = [described(field).get("rest") for field in fields]
    if all(level is not None for level in stored):
        return np.array([float(level or 0) for level in stored])
    return np.zeros(len(fields)) if len(t_ns) < 2 else rest_level(values, t_ns, REST_S)


def _by_taxel(fields: Sequence[pa.Field]) -> tuple[list[pa.Field], int]:
    """Return the columns ordered taxel by taxel, x, y, z of each, and 3; as they are, and 1, where they are no vectors."""
    vectors: dict[str, dict[str, pa.Field]] = {}
    for field in fields:
        about = described(field)
        axis = about.get("axis", "")
        part, shared = (axis, field.name.removesuffix(axis)) if axis else arm.split_name(field.name)
        vectors.setdefault(shared, {})[part] = field
    if vectors and all(set(vector) == set("xyz") for vector in vectors.values()):
        return [vector[axis] for vector in vectors.values() for axis in "xyz"], 3
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
    reach = max(float(np.quantile(np.abs(finite), SCALE_QUANTILE)), MIN_SCALE)
    return (-reach, reach) if float(np.quantile(finite, 1 - SCALE_QUANTILE)) < -0.1 * reach else (0.0, reach)


def binned(t_ns: Times, values: Floats, start_ns: int, stop_ns: int, bins: int) -> Floats:
    """Return what a signal (time, channel) has in each of ``bins`` equal times: the value farthest from 0, (bin, channel).

    A bin without rows repeats the one before it. Before the first row, and where a stream has ended, it is NaN.

    >>> binned(np.array([0, 1, 2, 9]), np.array([[1.0], [-3.0], [2.0], [5.0]]), 0, 10, 5).ravel().tolist()
    [-3.0, 2.0, 2.0, 2.0, 5.0]
    """
    peaks = np.full((bins, values.shape[1]), np.nan)
    if not len(t_ns):
        return peaks
    width_ns = max(stop_ns - start_ns, 1)
    place = np.clip((t_ns - start_ns) * bins // width_ns, 0, bins - 1)
    occupied, starts = np.unique(place, return_index=True)
    high, low = np.fmax.reduceat(values, starts, axis=0), np.fmin.reduceat(values, starts, axis=0)
    peaks[occupied] = np.where(np.abs(high) >= np.abs(low), high, low)
    spacing = int(np.median(np.diff(occupied))) if len(occupied) > 1 else bins
    ends = occupied[-1] + spacing
    latest = np.maximum.accumulate(np.where(np.isin(np.arange(bins), occupied), np.arange(bins), -1))
    covered = (latest >= 0) & (np.arange(bins) < ends)
    filled: Floats = np.where(covered[:, None], peaks[np.maximum(latest, 0)], np.nan)
    return filled


def image(colours: AnyArray, rows: int) -> AnyArray:
    """Return an image (row, bin, rgb) of colours (bin, channel, rgb), ``rows`` high for each channel."""
    return np.repeat(colours.transpose(1, 0, 2), rows, axis=0)
