"""The latents of a recording, which a fitted codec gives: what `tacpipe compress` adds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.codecs import codec as codecs
from tacpipe.codecs import frame_stacking, stored, tactile
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import SOME_ROWS

if TYPE_CHECKING:
    from tacpipe.codecs.codec import Flags, Floats
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns
    from tacpipe.plugins.stage import Fitted


def added(recording: Recording, fitted: Fitted) -> pa.Table | pa.RecordBatchReader:
    """Return the recording's table with its latents, float32 columns, by the codec whose files were ``fitted``.

    A codec with ``reads``, the number of rows up to each that its latents depend on, encodes a long recording in pieces,
    and these are returned as they are made; any other encodes it as a whole. Raises `TacpipeError` where the recording's
    channels are not those the codec was fitted on.
    """
    codec, columns = stored.load(fitted), recording.columns()
    channels = tactile.columns(columns.schema, "tactile")
    with _errors_naming(recording.name):
        codecs.check_channels(codec.channels, channels)
        begins = frame_stacking.breaks(tactile.times(columns))
        columns.forget()
        if getattr(codec, "reads", 0) and columns.num_rows > SOME_ROWS:
            return _in_pieces(recording.name, columns, codec, begins)
        table = recording.table()
        latents = codec.encode(tactile.above_rest(table, channels), channels, begins)  # (time, latent)
        return _with(table, codec, latents)


@contextmanager
def _errors_naming(name: str) -> Iterator[None]:
    """Have an error of encoding name the recording."""
    try:
        yield
    except TacpipeError as error:
        raise TacpipeError(f"{name}: {error}") from error


def _in_pieces(name: str, columns: Columns, codec: Any, begins: Flags) -> pa.RecordBatchReader:
    """Return the rows of a recording with their latents, each piece encoded behind the rows before it that it reads."""
    before = codec.reads - 1

    def batches() -> Iterator[pa.RecordBatch]:
        counts: Floats = np.zeros((0, len(codec.channels)))
        row = 0
        for table in columns.batches():
            lead = min(row, before)
            counts = np.concatenate([counts[len(counts) - lead :], tactile.above_rest(table, codec.channels)])
            with _errors_naming(name):
                latents = codec.encode(counts, codec.channels, begins[row - lead : row + table.num_rows])[lead:]
                piece = _with(table, codec, latents)
            yield from piece.combine_chunks().to_batches()
            row += table.num_rows

    return pa.RecordBatchReader.from_batches(_with(columns.schema.empty_table(), codec, None).schema, batches())


def _with(table: pa.Table, codec: codecs.FittedCodec, latents: Floats | None) -> pa.Table:
    """Return a table with its latents (time, latent), or with none for a table without rows."""
    values = np.zeros((0, len(codec.latents)), np.float32) if latents is None else latents
    stored.check_latents(codec, values, table.num_rows)
    for index, name in enumerate(codec.latents):
        field = pa.field(name, pa.float32(), metadata={"quantity": "latent", "unit": "1"})
        table = table.append_column(field, pa.array(values[:, index], pa.float32()))
    return table
