"""The curves of a stream: its channels by what they measure, with the names and units that a plot shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import arm

if TYPE_CHECKING:
    import pyarrow as pa

TIME = "t_ns"
_NO_CURVES = ("time", "sequence", "mask", "label", "image", "colour", "tactile", "prediction", "latent")  # quantities
_NO_UNIT = ("", "1")


@dataclass(frozen=True)
class Curves:
    """Channels of one stream, quantity and unit, which share an axis."""

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


def of_streams(streams: Mapping[str, pa.Table]) -> list[Curves]:
    """Return the curves of all streams with times, stream by stream, but for tactile channels, labels and clocks."""
    return [curves for stream, table in streams.items() for curves in of_table(stream, table)]


def of_table(stream: str, table: pa.Table) -> list[Curves]:
    """Return the curves of a stream, one for each quantity and unit in the order of its columns; see `of_streams`.

    Several vibration readings a row are one curve at their own rate, a finger.
    """
    if TIME not in table.column_names or table.num_rows < 2:
        return []
    t_ns = table.column(TIME).to_numpy()
    groups: dict[tuple[str, str, str], list[pa.Field]] = {}
    for field in table.schema:
        about = described(field)
        if _drawn(field, about):
            finger = about.get("finger", "") if about.get("quantity") == "vibration" else ""
            groups.setdefault((about.get("quantity", ""), about.get("unit", ""), finger), []).append(field)
    curves = []
    for (quantity, unit, finger), fields in groups.items():
        values = matrix(table, [field.name for field in fields])
        if quantity == "vibration" and len(fields) > 1:
            name = f"{finger} {len(fields)} readings a row".strip()
            curves.append(Curves(stream, quantity, unit, (name,), *unrolled(t_ns, values)))
        else:
            curves.append(Curves(stream, quantity, unit, short_names(fields), t_ns, values))
    return curves


def described(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a field as text."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def matrix(table: pa.Table, names: Sequence[str]) -> Floats:
    """Return columns of a table side by side as float64 (time, channel); nulls are NaN."""
    columns = [table.column(name).to_numpy() for name in names]
    return np.column_stack([np.asarray(column, dtype=np.float64) for column in columns])


def unrolled(t_ns: Times, values: Floats) -> tuple[Times, Floats]:
    """Return readings taken one after the other within each row (time, reading) as one channel: times, (time, 1).

    >>> [part.ravel().tolist() for part in unrolled(np.array([0, 10]), np.array([[1.0, 2.0], [3.0, 4.0]]))]
    [[0, 5, 10, 15], [1.0, 2.0, 3.0, 4.0]]
    """
    readings = values.shape[1]
    step_ns = np.append(np.diff(t_ns), np.median(np.diff(t_ns)))  # (time,)
    at_ns = t_ns[:, None] + (step_ns[:, None] * np.arange(readings) / readings).astype(np.int64)
    return at_ns.ravel(), values.reshape(-1, 1)


def short_names(fields: Sequence[pa.Field]) -> tuple[str, ...]:
    """Return names for a legend: the components where they are those of one vector, else the columns' names."""
    parts = [arm.component(field) for field in fields]
    one_vector = len({arm.shared_name(field) for field in fields}) == 1
    if len(fields) > 1 and one_vector and all(parts) and len(set(parts)) == len(parts):
        return tuple(parts)
    return tuple(str(field.name) for field in fields)


def _drawn(field: pa.Field, about: Mapping[str, str]) -> bool:
    import pyarrow as pa

    number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type) or pa.types.is_boolean(field.type)
    clock = field.name == TIME or field.name.startswith("t_") or field.name in ("seq", "device_seq")
    return number and not clock and about.get("quantity", "") not in _NO_CURVES
