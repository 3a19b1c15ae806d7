"""Select the tactile channels of a table, with their layout and their counts above rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.channels.schema import field_metadata
from tacpipe.channels.streams import columns_of_schema
from tacpipe.channels.streams import times as times
from tacpipe.codecs import codec as codecs
from tacpipe.datasets.dataset import Recording
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import SOME_ROWS
from tacpipe.plugins.stage import Fitted

LAYOUT = ("stream", "taxel", "axis")  # field metadata that describes the position of a channel


def columns(schema: pa.Schema, quantity: str) -> tuple[str, ...]:
    """Return the names of the columns with this ``quantity``, in the order of the table, without ground truth."""
    return tuple(columns_of_schema(schema, quantity))


def layout(schema: pa.Schema, channels: Sequence[str]) -> list[dict[str, str]]:
    """Return stream, taxel and axis of each channel, if its metadata contains them."""
    all_metadata = [field_metadata(schema.field(name)) for name in channels]
    return [{key: about[key] for key in LAYOUT if key in about} for about in all_metadata]


def rest_counts(schema: pa.Schema, channels: Sequence[str]) -> AnyFloats:
    """Return each channel's level without load in counts, shape (channel,), from its field metadata ``rest``.

    Raises `TacpipeError` if a channel has no such level.
    """
    levels = []
    for name in channels:
        level = field_metadata(schema.field(name)).get("rest")
        if level is None:
            raise TacpipeError(
                f"Channel {name} has no rest level, so its counts cannot be distinguished from its load. "
                "Run `tacpipe segment contacts` first: it writes the level into the column's metadata."
            )
        levels.append(float(level))
    return np.array(levels, dtype=np.float64)


def matrix(table: pa.Table, names: Sequence[str]) -> AnyFloats:
    """Return the named columns as a float64 matrix (time, column)."""
    values = np.empty((table.num_rows, len(names)))
    for index, name in enumerate(names):
        values[:, index] = table.column(name).to_numpy()
    return values


def above_rest(table: pa.Table, channels: Sequence[str]) -> AnyFloats:
    """Return the channels' counts above their rest level as float64, shape (time, channel)."""
    return matrix(table, channels) - rest_counts(table.schema, channels)


def add_latents(recording: Recording, fitted: Fitted) -> pa.Table | pa.RecordBatchReader:
    """Return the recording's table with its latents as float32 columns, encoded by the codec whose files are ``fitted``.

    If a codec has the attribute ``reads``, the number of rows that the latents of a row depend on, a long recording is
    encoded in chunks, which are returned one by one. Otherwise it is encoded at once. Raises `TacpipeError` if the
    recording's channels are not those that the codec was fitted on.
    """
    codec, stored_columns = codecs.load(fitted), recording.columns()
    channels = columns(stored_columns.schema, "tactile")
    with _prefix_errors(recording.name):
        codecs.check_channels(codec.channels, channels)
        begins = codecs.run_starts(times(stored_columns))
        stored_columns.forget()
        if getattr(codec, "reads", 0) and stored_columns.num_rows > SOME_ROWS:
            return _encode_in_chunks(recording.name, stored_columns, codec, begins)
        table = recording.table()
        latents = codec.encode(above_rest(table, channels), channels, begins)  # (time, latent)
        return _append_latents(table, codec, latents)


@contextmanager
def _prefix_errors(name: str) -> Iterator[None]:
    """Prefix errors in the block with the recording's name."""
    try:
        yield
    except TacpipeError as error:
        raise TacpipeError(f"{name}: {error}") from error


def _encode_in_chunks(name: str, stored_columns: Columns, codec: Any, begins: Bools) -> pa.RecordBatchReader:
    """Return the rows of a recording with their latents; each chunk is encoded with the previous rows it depends on.

    Raises `TacpipeError` with the recording's name, also while the rows are read.
    """
    previous_rows = codec.reads - 1

    def batches() -> Iterator[pa.RecordBatch]:
        counts: AnyFloats = np.zeros((0, len(codec.channels)))
        row = 0
        for table in stored_columns.batches():
            lead = min(row, previous_rows)
            counts = np.concatenate([counts[len(counts) - lead :], above_rest(table, codec.channels)])
            with _prefix_errors(name):
                latents = codec.encode(counts, codec.channels, begins[row - lead : row + table.num_rows])[lead:]
                piece = _append_latents(table, codec, latents)
            yield from piece.combine_chunks().to_batches()
            row += table.num_rows

    return pa.RecordBatchReader.from_batches(
        _append_latents(stored_columns.schema.empty_table(), codec, None).schema, batches()
    )


def _append_latents(table: pa.Table, codec: codecs.FittedCodec, latents: AnyFloats | None) -> pa.Table:
    """Return a table with latents (time, latent) appended as columns; None appends empty columns to an empty table.

    Raises `TacpipeError` if the latents have another shape.
    """
    values = np.zeros((0, len(codec.latents)), np.float32) if latents is None else latents
    codecs.check_latents(codec, values, table.num_rows)
    extended = table
    for index, name in enumerate(codec.latents):
        field = pa.field(name, pa.float32(), metadata={"quantity": "latent", "unit": "1"})
        extended = extended.append_column(field, pa.array(values[:, index], pa.float32()))
    return extended
