"""Extract the curves of a stream for plots, with names and units, and paths of positions in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Times
from tacpipe.channels import arm
from tacpipe.channels.arm import METRES, ORIENTATION, POSITION
from tacpipe.channels.schema import field_metadata

TIME = "t_ns"
# quantities
_UNDRAWN_QUANTITIES = ("time", "sequence", "mask", "label", "image", "colour", "tactile", "prediction", "latent")
_NO_UNIT = ("", "1")


@dataclass(frozen=True)
class Curves:
    """The channels of a stream with the same quantity and unit, which share an axis."""

    stream: str
    quantity: str
    unit: str
    names: tuple[str, ...]  # channel names
    t_ns: Times  # (time,)
    values: Floats  # (time, channel)

    @property
    def title(self) -> str:
        """The title of their plot: stream, quantity and unit."""
        quantity = self.quantity.replace("_", " ") or ", ".join(self.names[:3])
        name = quantity if quantity == self.stream.replace("_", " ") else f"{self.stream} {quantity}".strip()
        return name if self.unit in _NO_UNIT else f"{name} ({self.unit})"


def curves_of_streams(streams: Mapping[str, pa.Table]) -> list[Curves]:
    """Return the curves of all streams with times, stream by stream, except tactile channels, labels and clocks."""
    return [curves for stream, table in streams.items() for curves in curves_of_table(stream, table)]


def curves_of_table(stream: str, table: pa.Table) -> list[Curves]:
    """Return the curves of a stream, a group per quantity and unit, in the order of its columns.

    If rows contain several vibration readings, these become one curve per finger, at the rate of the readings.
    """
    if TIME not in table.column_names or table.num_rows < 2:
        return []
    t_ns = table.column(TIME).to_numpy()
    groups: dict[tuple[str, str, str], list[pa.Field]] = {}
    for field in table.schema:
        about = field_metadata(field)
        if _is_drawn(field, about):
            finger = about.get("finger", "") if about.get("quantity") == "vibration" else ""
            groups.setdefault((about.get("quantity", ""), about.get("unit", ""), finger), []).append(field)
    curves = []
    for (quantity, unit, finger), fields in groups.items():
        values = matrix(table, [field.name for field in fields])
        if quantity == "vibration" and len(fields) > 1:
            name = f"{finger} {len(fields)} readings per row".strip()
            curves.append(Curves(stream, quantity, unit, (name,), *unroll_readings(t_ns, values)))
        else:
            curves.append(Curves(stream, quantity, unit, short_names(fields), t_ns, values))
    return [*curves, *_forecast_curves(stream, table)]


def _forecast_curves(stream: str, table: pa.Table) -> list[Curves]:
    """Return the channel that varies most with its forecasts, at the times that they are for; empty without forecasts.

    A forecast of ``step`` rows ahead stands ``step`` rows after the row that it was made at; the first rows have none.
    """
    steps: dict[str, list[tuple[int, str]]] = {}
    for field in table.schema:
        step, channel = int(field_metadata(field).get("step", "0")), field.name.rpartition("_t")[0]
        if step and channel in table.column_names and step < table.num_rows:
            steps.setdefault(channel, []).append((step, field.name))
    if not steps:
        return []
    spread = {channel: np.ptp(values[np.isfinite(values)]) for channel in steps
              if np.isfinite(values := matrix(table, [channel])[:, 0]).any()}  # fmt: skip
    channel = max(spread, key=lambda name: float(spread[name]), default=next(iter(steps)))
    values = matrix(table, [channel, *(name for _, name in sorted(steps[channel]))])
    for column, (step, _) in enumerate(sorted(steps[channel]), start=1):
        values[step:, column], values[:step, column] = values[:-step, column].copy(), np.nan
    names = (
        "measured",
        *(f"forecast {step} {'row' if step == 1 else 'rows'} ahead" for step, _ in sorted(steps[channel])),
    )
    unit = field_metadata(table.schema.field(channel)).get("unit", "")
    return [Curves(stream, channel, unit, names, table.column(TIME).to_numpy(), values)]


def matrix(table: pa.Table, names: Sequence[str]) -> Floats:
    """Return columns of a table as a float64 matrix (time, channel); nulls are NaN."""
    columns = [table.column(name).to_numpy() for name in names]
    return np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])


def unroll_readings(t_ns: Times, values: Floats) -> tuple[Times, Floats]:
    """Return the times and values (time, 1) of rows of successive readings (time, reading), flattened to one channel.

    >>> [part.ravel().tolist() for part in unroll_readings(np.array([0, 10]), np.array([[1.0, 2.0], [3.0, 4.0]]))]
    [[0, 5, 10, 15], [1.0, 2.0, 3.0, 4.0]]
    """
    readings = values.shape[1]
    step_ns = np.append(np.diff(t_ns), np.median(np.diff(t_ns)))  # (time,)
    reading_ns = t_ns[:, None] + (step_ns[:, None] * np.arange(readings) / readings).astype(np.int64)
    return reading_ns.ravel(), values.reshape(-1, 1)


def short_names(fields: Sequence[pa.Field]) -> tuple[str, ...]:
    """Return names for a legend: the components if the fields are one vector, otherwise the column names."""
    parts = [arm.component(field) for field in fields]
    one_vector = len({arm.shared_name(field) for field in fields}) == 1
    if len(fields) > 1 and one_vector and all(parts) and len(set(parts)) == len(parts):
        return tuple(parts)
    return tuple(str(field.name) for field in fields)


def _is_drawn(field: pa.Field, about: Mapping[str, str]) -> bool:
    """Return whether a column is drawn as a curve: a number that is neither a clock nor of an undrawn quantity."""
    is_number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type) or pa.types.is_boolean(field.type)
    is_clock = field.name == TIME or field.name.startswith("t_") or field.name in ("seq", "device_seq")
    return is_number and not is_clock and about.get("quantity", "") not in _UNDRAWN_QUANTITIES


@dataclass(frozen=True)
class Path:
    """A path in metres, without the rows whose position is not finite."""

    name: str
    t_ns: Times  # (time,)
    position_m: Floats  # (time, xyz)
    quaternion: Floats | None = None  # (time, xyzw), if the stream has one orientation


def paths_of_streams(streams: Mapping[str, pa.Table]) -> list[Path]:
    """Return the paths of all streams, except clouds, whose rows are points."""
    return [path for stream, table in streams.items() for path in paths_of_table(stream, table)]


def paths_of_table(stream: str, table: pa.Table) -> list[Path]:
    """Return the paths of a stream, one for each position in m, cm or mm with the components x, y and z."""
    if TIME not in table.column_names or not table.num_rows:
        return []
    t_ns = table.column(TIME).to_numpy()
    if 2 * len(np.unique(t_ns)) < len(t_ns):  # a cloud's points share a timestamp
        return []
    positions = _vectors(table, POSITION, "xyz")
    orientations = _vectors(table, ORIENTATION, "xyzw")
    quaternion = (
        matrix(table, [field.name for field in next(iter(orientations.values()))]) if len(orientations) == 1 else None
    )
    paths = []
    for shared, fields in positions.items():
        scale = [METRES.get(field_metadata(field).get("unit", "m")) for field in fields]
        if None in scale:
            continue
        position_m = matrix(table, [field.name for field in fields]) * np.array(scale, dtype=np.float64)
        valid = np.isfinite(position_m).all(axis=1)
        if quaternion is not None:
            valid &= np.isfinite(quaternion).all(axis=1) & (np.abs(quaternion).sum(axis=1) > 0)
        if valid.any():
            part = f"{stream} {shared.split('_')[0]}".strip() if len(positions) > 1 else stream or "position"
            paths.append(Path(part, t_ns[valid], position_m[valid], None if quaternion is None else quaternion[valid]))
    return paths


def _vectors(table: pa.Table, quantity: str, parts: str) -> dict[str, list[pa.Field]]:
    """Return the columns of each vector of a quantity that has all of ``parts``, in this order."""
    by_name: dict[str, dict[str, pa.Field]] = {}
    for field in table.schema:
        if field_metadata(field).get("quantity") == quantity:
            common_name = arm.split_name(field.name)[1]
            by_name.setdefault(common_name, {})[arm.component(field)] = field
    return {
        name: [fields_by_part[part] for part in parts]
        for name, fields_by_part in by_name.items()
        if set(fields_by_part) == set(parts)
    }
