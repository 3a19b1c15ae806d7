"""Compare samples of a recording with those that a ledger lists as sent: all their values, and their rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.sensors.sensor import Samples

if TYPE_CHECKING:
    import pyarrow as pa

STAMPS = (
    "t_ns",
    "t_uncertain_ns",
    "t_device_ns",
    "seq",
    "device_seq",
)  # columns of a recorded stream that are no channels


def sent_columns(samples: Samples) -> list[AnyArray]:
    """Return the values of each channel (sample,)."""
    return [column for block in samples.values for column in block.T]


def recorded_columns(table: pa.Table) -> list[AnyArray]:
    """Return the values of each channel of a recorded stream (sample,), without stamps and counters."""
    names = [name for name in table.column_names if name not in STAMPS]
    return [table.column(name).to_numpy(zero_copy_only=False) for name in names]


def keys(columns: Sequence[AnyArray]) -> list[bytes]:
    """Return all values of each sample as bytes (sample,); of texts their hash, good within one process."""
    texts = [column for column in columns if column.dtype.kind == "O"]
    parts = [column for column in columns if column.dtype.kind != "O"]
    parts += [np.array([hash(str(cell)) for cell in column.tolist()]) for column in texts]
    rows = [np.ascontiguousarray(part).view(np.uint8).reshape(len(part), -1) for part in parts]
    return [row.tobytes() for row in np.hstack(rows)]


def start_of(table: pa.Table, samples: Samples) -> int | None:
    """Return the row of ``samples`` from which on they are those of a recorded stream, one by one; None if nowhere.

    The stream must be one of a sensor that counts: its first count shows where to look.
    """
    assert samples.seq is not None
    recorded, sent = recorded_columns(table), sent_columns(samples)
    for start in np.flatnonzero(samples.seq == table.column("seq")[0].as_py()).tolist():
        stop = start + table.num_rows
        if all(
            np.array_equal(ours, theirs[start:stop], equal_nan=True)
            for ours, theirs in zip(recorded, sent, strict=True)
        ):
            return int(start)
    return None
