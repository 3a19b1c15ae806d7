"""The tactile channels of a table: which they are, where they sit, and their counts above rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.channels.masks import gaps as gaps
from tacpipe.channels.masks import times as times
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]

LAYOUT = ("stream", "taxel", "axis")  # field metadata that describes where a channel lies


def metadata(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a column as text, empty where it has none."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def columns(schema: pa.Schema, quantity: str) -> tuple[str, ...]:
    """Return the names of the columns whose field metadata has this ``quantity``, in the order of the table."""
    return tuple(field.name for field in schema if metadata(field).get("quantity") == quantity)


def layout(schema: pa.Schema, channels: Sequence[str]) -> list[dict[str, str]]:
    """Return stream, taxel and axis of each channel, as far as its metadata names them."""
    described = [metadata(schema.field(name)) for name in channels]
    return [
        {key: metadata_of_channel[key] for key in LAYOUT if key in metadata_of_channel}
        for metadata_of_channel in described
    ]


def rest_counts(schema: pa.Schema, channels: Sequence[str]) -> Floats:
    """Return each channel's level without load in counts, shape (channel,), from its field metadata ``levels``.

    Raises `TacpipeError` where a channel has none.
    """
    levels = []
    for name in channels:
        level = metadata(schema.field(name)).get("rest")
        if level is None:
            raise TacpipeError(
                f"Channel {name} has no rest level, so its counts cannot be distinguished from its load. "
                "Run `tacpipe segment contacts` first: it writes the level into the column's metadata."
            )
        levels.append(float(level))
    return np.array(levels, dtype=np.float64)


def matrix(table: pa.Table, names: Sequence[str]) -> Floats:
    """Return the named columns side by side as float64, shape (time, column)."""
    values = np.empty((table.num_rows, len(names)))
    for index, name in enumerate(names):
        values[:, index] = table.column(name).to_numpy()
    return values


def above_rest(table: pa.Table, channels: Sequence[str]) -> Floats:
    """Return the channels' counts above their rest level as float64, shape (time, channel)."""
    return matrix(table, channels) - rest_counts(table.schema, channels)
