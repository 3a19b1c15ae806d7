"""The columns of one recording as arrays and tensors, every value as its Parquet file holds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.channels.streams import TRUTH
from tacpipe.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa
    import torch

TIME = "t_ns"
CLOCKS = (TIME, "t_device_ns", "seq", "device_seq")  # clocks and counters, where no metadata states what a column is
NOT_CHANNELS = ("time", "sequence", "mask", "label", "status", "text")  # quantities of columns that no sensor measured
EXACT = 1 << 53  # up to here a float64 holds every whole number


@dataclass(frozen=True, eq=False)
class Arrays:
    """A stream of one recording: each column as an array of its own type, and its channels as one matrix.

    A channel is a column of numbers that was measured: no clock, counter, mask, label, status or text, and no ground
    truth of a simulation (``gt_…``). Which columns are channels follows from their types, names and field metadata
    ``quantity``, never from their values.
    """

    by_column: Mapping[str, AnyArray]  # name -> (time,), in the column's own type; a masked array where it has nulls
    columns: tuple[str, ...]  # the channels: names of the columns of `values`, in order

    def __getitem__(self, name: str) -> AnyArray:
        """Return one column, channel or not, in its own type (time,). Raises `KeyError` where it was not read."""
        return self.by_column[name]

    @property
    def t_ns(self) -> Int64s | None:
        """The times of the rows in nanoseconds, int64 (time,); None where the stream has none or they were not read."""
        return self.by_column.get(TIME)

    @cached_property
    def values(self) -> AnyArray:
        """The channels side by side (time, channel), in the smallest type that holds each of them; null becomes NaN.

        Raises `UsageError` where no common type holds every value: an integer beyond 2^53 next to a float.
        """
        channels = {name: self.by_column[name] for name in self.columns}
        kinds: list[Any] = [array.dtype for array in channels.values()]
        if any(np.ma.isMaskedArray(array) for array in channels.values()):
            kinds.append(np.float32)
        common = np.result_type(*kinds) if kinds else np.dtype(np.float64)
        rows = max(map(len, self.by_column.values()), default=0)
        values = np.empty((rows, len(channels)), common)  # (time, channel)
        for index, (name, array) in enumerate(channels.items()):
            if common.kind == "f" and array.dtype.kind in "iu" and _beyond(array):
                raise UsageError(
                    f"The channel {name} ({array.dtype}) holds integers beyond 2^53, which {common} would round, so "
                    f"there is no one matrix of these channels. Read it alone: arrays[{name!r}] has its own type."
                )
            with np.errstate(invalid="ignore"):  # A signalling NaN is NaN in any type
                values[:, index] = np.ma.getdata(array)
            if np.ma.isMaskedArray(array):
                values[np.ma.getmaskarray(array), index] = np.nan
        return values


@dataclass(frozen=True, eq=False)
class Tensors:
    """A stream of one recording as tensors: times apart from the channels, as in `Arrays`, with the same types."""

    t_ns: torch.Tensor | None  # int64 (time,), nanoseconds; None where the stream has none or they were not read
    values: torch.Tensor  # (time, channel)
    columns: tuple[str, ...]  # the channels: names of the columns of `values`, in order


def of_table(table: pa.Table) -> Arrays:
    """Return the columns of ``table`` as arrays, in its order."""
    by_column = {field.name: _array(column) for field, column in zip(table.schema, table.columns, strict=True)}
    return Arrays(by_column, tuple(field.name for field in table.schema if is_channel(field)))


def to_tensors(arrays: Arrays) -> Tensors:
    """Return times and channels of ``arrays`` as tensors. Raises `UsageError` where a time is null."""
    import torch

    t_ns = arrays.t_ns
    if np.ma.isMaskedArray(t_ns):
        raise UsageError(f"The column {TIME} holds nulls, which no tensor of integers can hold. Read it with to_numpy.")
    times = None if t_ns is None else torch.from_numpy(t_ns.copy())
    return Tensors(times, torch.from_numpy(arrays.values), arrays.columns)


def is_channel(field: pa.Field) -> bool:
    """Return whether a column is a channel, as `Arrays` defines it.

    >>> import pyarrow as pa
    >>> is_channel(pa.field("x", pa.int16())), is_channel(pa.field("seq", pa.int64()))
    (True, False)
    """
    import pyarrow as pa

    if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
        return False
    if field.name in CLOCKS or field.name.startswith(TRUTH):
        return False
    return (field.metadata or {}).get(b"quantity", b"").decode() not in NOT_CHANNELS


def _array(column: pa.ChunkedArray) -> AnyArray:
    """Return a column in its own type (time,): pyarrow alone would make floats of integers with nulls."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column.type
    if not column.null_count or not (pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        values: AnyArray = column.to_numpy()
        return values
    filled = pc.fill_null(column, pa.scalar(0, pa.int8()).cast(kind)).to_numpy()
    masked: AnyArray = np.ma.masked_array(filled, mask=column.is_null().to_numpy())
    return masked


def _beyond(array: AnyArray) -> bool:
    values = np.ma.getdata(array)
    return values.dtype.itemsize == 8 and bool(((values > EXACT) | (values < -EXACT)).any())
