"""Compute the taxels of a sensor over time: positions, distance from rest, and an image of all taxels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import arm, places
from tacpipe.channels.schema import field_metadata
from tacpipe.signals.contact import rest_level
from tacpipe.traces.curves import TIME, matrix

REST_S = 0.2  # duration at the start whose median is the level without load, if no segmentation stored a level
SCALE_QUANTILE = 0.995  # quantile for the end of a scale, so that a single wrong reading does not darken all others
MIN_SCALE = 0.5  # minimum end of a scale, in the unit of the values


@dataclass(frozen=True)
class Taxels:
    """The taxels of one finger. A single row is not changed, because its level at rest is unknown."""

    stream: str
    finger: str  # name of the finger if the stream has several, else empty
    unit: str
    names: tuple[str, ...]  # taxel names
    channels: tuple[str, ...]  # the columns, ordered by taxel
    places: Floats  # (taxel, 2), to the right and up
    places_unit: str  # mm, or grid
    t_ns: Times  # (time,)
    change: Floats  # (time, taxel, axis), change from rest; axes are x, y, z or a single one
    rest_levels: Floats  # (channel,), which were subtracted

    @property
    def name(self) -> str:
        """The stream, and the finger if it has several."""
        return f"{self.stream} {self.finger}".strip()

    @property
    def magnitude(self) -> Floats:
        """The distance of each taxel from rest (time, taxel): the length of its vector, or the signed change."""
        if self.change.shape[2] == 1:
            return self.change[:, :, 0]
        return np.asarray(np.sqrt(np.einsum("tna,tna->tn", self.change, self.change)))

    @property
    def load(self) -> Floats:
        """The mean distance of the taxels from rest (time,), to which `tacpipe segment contacts` applies its thresholds."""
        return np.asarray(np.abs(self.magnitude).mean(axis=1))


def taxels_from_streams(streams: Mapping[str, pa.Table]) -> list[Taxels]:
    """Return the taxels of all streams, by finger."""
    return [taxels for stream, table in streams.items() for taxels in taxels_from_table(stream, table)]


def taxels_from_table(stream: str, table: pa.Table) -> list[Taxels]:
    """Return the taxels of a stream's tactile columns, by finger; empty if the stream has no times.

    The level without load is that of the field metadata (``rest``, written by `tacpipe segment contacts`), otherwise
    the median of the first 0.2 s.
    """
    if TIME not in table.column_names or not table.num_rows:
        return []
    fingers: dict[str, list[pa.Field]] = {}
    for field in table.schema:
        about = field_metadata(field)
        if about.get("quantity") == "tactile":
            fingers.setdefault(about.get("finger", ""), []).append(field)
    return [_taxels_from_fields(stream, finger, table, fields) for finger, fields in fingers.items()]


def _taxels_from_fields(stream: str, finger: str, table: pa.Table, fields: Sequence[pa.Field]) -> Taxels:
    """Return the taxels of a finger with tactile columns ``fields``; ``finger`` is "" if the stream has only one finger."""
    ordered, axes = _order_by_taxel(fields)
    columns = [field.name for field in ordered]
    t_ns, values = table.column(TIME).to_numpy(), matrix(table, columns)
    firsts = ordered[::axes]
    positions, unit = places.taxel_positions(firsts)
    levels = _rest_levels(ordered, values, t_ns)
    names = tuple(field.name.rpartition("_")[0] if axes == 3 else field.name for field in firsts)
    if finger:
        names = tuple(name.removeprefix(f"{finger}_") for name in names)
    return Taxels(
        stream,
        finger,
        field_metadata(firsts[0]).get("unit", ""),
        names,
        tuple(columns),
        positions,
        unit,
        t_ns,
        (values - levels).reshape(len(t_ns), -1, axes),
        levels,
    )


def _rest_levels(fields: Sequence[pa.Field], values: Floats, t_ns: Times) -> Floats:
    stored = [field_metadata(field).get("rest") for field in fields]
    if all(level is not None for level in stored):
        return np.array([float(level or 0) for level in stored])
    return np.zeros(len(fields)) if len(t_ns) < 2 else rest_level(values, t_ns, REST_S)


def _order_by_taxel(fields: Sequence[pa.Field]) -> tuple[list[pa.Field], int]:
    """Return the columns ordered by taxel as x, y, z, and 3; if they are not vectors, the columns unchanged, and 1."""
    vectors: dict[str, dict[str, pa.Field]] = {}
    for field in fields:
        about = field_metadata(field)
        axis = about.get("axis", "")
        part, taxel_name = (axis, field.name.removesuffix(axis)) if axis else arm.split_name(field.name)
        vectors.setdefault(taxel_name, {})[part] = field
    if vectors and all(set(vector) == set("xyz") for vector in vectors.values()):
        return [vector[axis] for vector in vectors.values() for axis in "xyz"], 3
    return list(fields), 1


def scale(values: Floats) -> tuple[float, float]:
    """Return the ends of a colour scale: 0 and the 99.5 % quantile of ``values``, or ± that quantile if both signs occur.

    For values far from 0, such as raw readings, the ends are their minimum and maximum; (0, 1) without values.
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if low > 0.2 * high > 0:
        return low, high
    reach = max(float(np.quantile(np.abs(finite), SCALE_QUANTILE)), MIN_SCALE)
    has_negatives = float(np.quantile(finite, 1 - SCALE_QUANTILE)) < -0.1 * reach
    return (-reach if has_negatives else 0.0), reach


def bin_peaks(t_ns: Times, values: Floats, start_ns: int, stop_ns: int, bins: int) -> Floats:
    """Return the value farthest from 0 of a signal (time, channel) in each of ``bins`` equal intervals, (bin, channel).

    A bin without rows repeats the previous one. Before the first row, and after the end of the stream, bins are NaN.

    >>> bin_peaks(np.array([0, 1, 2, 9]), np.array([[1.0], [-3.0], [2.0], [5.0]]), 0, 10, 5).ravel().tolist()
    [-3.0, 2.0, 2.0, 2.0, 5.0]
    """
    peaks = np.full((bins, values.shape[1]), np.nan)
    if not len(t_ns):
        return peaks
    width_ns = max(stop_ns - start_ns, 1)
    bin_index = np.clip((t_ns - start_ns) * bins // width_ns, 0, bins - 1)
    occupied, starts = np.unique(bin_index, return_index=True)
    high, low = np.fmax.reduceat(values, starts, axis=0), np.fmin.reduceat(values, starts, axis=0)
    peaks[occupied] = np.where(np.abs(high) >= np.abs(low), high, low)
    spacing = int(np.median(np.diff(occupied))) if len(occupied) > 1 else bins
    ends = occupied[-1] + spacing
    latest = np.maximum.accumulate(np.where(np.isin(np.arange(bins), occupied), np.arange(bins), -1))
    covered = (latest >= 0) & (np.arange(bins) < ends)
    return np.where(covered[:, None], peaks[np.maximum(latest, 0)], np.nan)


def image(colours: AnyArray, rows: int) -> AnyArray:
    """Return an image (row, bin, rgb) of colours (bin, channel, rgb), with ``rows`` rows per channel."""
    return np.repeat(colours.transpose(1, 0, 2), rows, axis=0)
