"""A finger's stream: found among those of its recording, with readings repaired that cannot be true."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Int64s
from tacpipe.channels.absent import absent
from tacpipe.channels.streams import of_quantity
from tacpipe.errors import TacpipeError
from tacpipe.signals.spikes import hampel

if TYPE_CHECKING:
    import pyarrow as pa


def finger(name: str, streams: Mapping[str, pa.Table]) -> pa.Table:
    """Return the only stream with tactile channels. Raises `TacpipeError`, naming the recording, for none or several."""
    found = [stream for stream, table in streams.items() if of_quantity(table, "tactile")]
    if not found:
        raise absent(name, "tactile", {stream: table.schema for stream, table in streams.items()})
    if len(found) != 1:
        raise TacpipeError(
            f"Recording {name} has {len(found)} streams with tactile channels: {', '.join(found)}; a "
            f"slide is cut from one. Give recordings of one finger, or of one patch of skin."
        )
    return streams[found[0]]


def without_spikes(table: pa.Table, rows: int, deviations: float, floor_count: float) -> tuple[pa.Table, Int64s]:
    """Return the stream with spikes of its tactile channels removed, and how many each row had (time,); see `hampel`."""
    import pyarrow as pa

    names = of_quantity(table, "tactile")
    values = np.column_stack([table.column(name).to_numpy() for name in names])  # (time, channel)
    spikes, whole = hampel(values, rows, deviations, floor_count)
    for channel in np.flatnonzero(spikes.any(axis=0)):
        field = table.schema.field(names[channel])
        column = pa.array(whole[:, channel].copy(), field.type)
        table = table.set_column(table.column_names.index(field.name), field, column)
    return table, spikes.sum(axis=1)
