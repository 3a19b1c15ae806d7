"""Read recordings as arrays, tensors and data frames, with every value as in its Parquet file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.channels.schema import is_truth
from tacpipe.datasets import selection
from tacpipe.errors import UsageError
from tacpipe.printable import plain

if TYPE_CHECKING:
    import duckdb
    import pandas as pd
    import pyarrow as pa
    import torch

    from tacpipe.datasets.reading import ReadableDataset
    from tacpipe.plugins.stage import Attribute

TIME = "t_ns"
CLOCKS = (TIME, "t_device_ns", "seq", "device_seq")  # clocks and counters, for columns without metadata
# quantities of columns that are not measurements
NOT_CHANNELS = ("time", "sequence", "mask", "label", "status", "text")
EXACT = 1 << 53  # a float64 represents every integer up to this


@dataclass(frozen=True, eq=False)
class Arrays:
    """A stream of one recording: each column as an array of its own type, and its channels as one matrix.

    A channel is a numeric column that was measured: not a clock, counter, mask, label, status or text, and not ground
    truth of a simulation (``gt_…``). Types, names and the field metadata ``quantity`` determine which columns are
    channels, never the values.
    """

    by_column: Mapping[str, AnyArray]  # array (time,) by name, in the column's own type; a masked array if it has nulls
    columns: tuple[str, ...]  # the channels: column names of `values`, in order

    def __getitem__(self, name: str) -> AnyArray:
        """Return any column in its own type (time,). Raises `KeyError` if it was not read."""
        return self.by_column[name]

    @property
    def t_ns(self) -> Int64s | None:
        """The times of the rows in nanoseconds, int64 (time,); None if the stream has no times or they were not read."""
        return self.by_column.get(TIME)

    @cached_property
    def values(self) -> AnyArray:
        """The channels as columns (time, channel), in the smallest type that represents each of them; null becomes NaN.

        Raises `UsageError` if no common type represents every value: an integer beyond 2^53 next to a float.
        """
        channels = {name: self.by_column[name] for name in self.columns}
        kinds: list[Any] = [array.dtype for array in channels.values()]
        if any(np.ma.isMaskedArray(array) for array in channels.values()):
            kinds.append(np.float32)
        common = np.result_type(*kinds) if kinds else np.dtype(np.float64)
        rows = max(map(len, self.by_column.values()), default=0)
        values = np.empty((rows, len(channels)), common)  # (time, channel)
        for index, (name, array) in enumerate(channels.items()):
            if common.kind == "f" and array.dtype.kind in "iu" and _exceeds_exact_range(array):
                raise UsageError(
                    f"The channel {name} ({array.dtype}) holds integers beyond 2^53, which {common} would round, so "
                    f"there is no one matrix of these channels. Read it separately: arrays[{name!r}] has its own type."
                )
            with np.errstate(invalid="ignore"):  # a signalling NaN is NaN in any type
                values[:, index] = np.ma.getdata(array)
            if np.ma.isMaskedArray(array):
                values[np.ma.getmaskarray(array), index] = np.nan
        return values


@dataclass(frozen=True, eq=False)
class Tensors:
    """A stream of one recording as tensors: times and channels, with the types of `Arrays`."""

    t_ns: torch.Tensor | None  # int64 (time,), nanoseconds; None if the stream has no times or they were not read
    values: torch.Tensor  # (time, channel)
    columns: tuple[str, ...]  # the channels: column names of `values`, in order


def arrays_of_table(table: pa.Table) -> Arrays:
    """Return the columns of ``table`` as arrays, in order."""
    by_column = {field.name: _to_array(column) for field, column in zip(table.schema, table.columns, strict=True)}
    return Arrays(by_column, tuple(field.name for field in table.schema if is_channel(field)))


def to_tensors(arrays: Arrays) -> Tensors:
    """Return times and channels of ``arrays`` as tensors. Raises `UsageError` if a time is null."""
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
    if field.name in CLOCKS or is_truth(field):
        return False
    return (field.metadata or {}).get(b"quantity", b"").decode() not in NOT_CHANNELS


def _to_array(column: pa.ChunkedArray) -> AnyArray:
    """Return a column in its own type (time,); pyarrow would convert integers with nulls to floats."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = column.type
    if not column.null_count or not (pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        values: AnyArray = column.to_numpy()
        return values
    filled = pc.fill_null(column, pa.scalar(0, pa.int8()).cast(kind)).to_numpy()
    masked: AnyArray = np.ma.masked_array(filled, mask=column.is_null().to_numpy())
    return masked


def _exceeds_exact_range(array: AnyArray) -> bool:
    values = np.ma.getdata(array)
    return values.dtype.itemsize == 8 and bool(((values > EXACT) | (values < -EXACT)).any())


ONE_TABLE, LABELS_TABLE = "data", "labels"  # views of `connect_duckdb`


def labels_frame(dataset: ReadableDataset) -> pd.DataFrame:
    """Return the attributes as a frame with one row per recording (index ``recording``) and one column per attribute.

    Integers and booleans that some recordings lack have pandas' nullable types; other columns have the type of their
    values.
    """
    import pandas as pd

    index = pd.Index(list(dataset.recordings), name="recording", dtype=object)
    columns = {
        name: _series(pd.Series([recording.attributes.get(name) for recording in dataset], index=index, dtype=object))
        for name in _names(dataset)
    }
    return pd.DataFrame(columns, index=index)


def _series(values: pd.Series[Any]) -> pd.Series[Any]:
    return values.convert_dtypes() if values.isna().any() else values.infer_objects()


def _names(dataset: ReadableDataset) -> list[str]:
    """Return the names of all attributes, in the order of the recordings' attributes."""
    return list(dict.fromkeys(name for recording in dataset for name in recording.attributes))


def add_label_columns(
    dataset: ReadableDataset, tables: Mapping[str, pa.Table], names: Sequence[str] | None = None
) -> dict[str, pa.Table]:
    """Return the tables of recordings with a column added for each attribute in ``names``, or for all if it is None.

    Missing attributes are null. Raises `UsageError` for an attribute that no recording has or that has the name of a column.
    """
    import pyarrow as pa

    existing = _names(dataset)
    selected = existing if names is None else list(dict.fromkeys(names))
    for name in selected:
        if name not in existing:
            raise selection.unknown_label(dataset, name)
        if any(name in table.column_names for table in tables.values()):
            addable = [label for label in existing if not any(label in table.column_names for table in tables.values())]
            raise UsageError(
                f"{plain(name)} is a label and a column of the recordings. Name the labels to add, as labels={addable!r}."
            )
    labelled_tables = {}
    kinds = {name: _kind([dataset[recording].attributes.get(name) for recording in tables]) for name in selected}
    for recording, table in tables.items():
        labelled_table = table
        for name in selected:
            value = pa.scalar(_as(dataset[recording].attributes.get(name), kinds[name]), kinds[name])
            labelled_table = labelled_table.append_column(name, pa.repeat(value, table.num_rows))
        labelled_tables[recording] = labelled_table
    return labelled_tables


def _kind(values: Sequence[Attribute]) -> pa.DataType:
    """Return the arrow type that represents all of these values, which is text if they have several types."""
    import pyarrow as pa

    types = {type(value) for value in values if value is not None}
    if types <= {bool} and types:
        return pa.bool_()
    if types <= {int} and types:
        return pa.int64()
    return pa.float64() if types <= {int, float} and types else pa.string()


def _as(value: Attribute, kind: pa.DataType) -> Any:
    import pyarrow as pa

    return str(value) if value is not None and pa.types.is_string(kind) else value


def to_pandas(table: pa.Table) -> pd.DataFrame:
    """Return an arrow table as a frame, with the units of the columns in ``attrs["units"]``.

    Integers with nulls become pandas' nullable integers.
    """
    import pandas as pd
    import pyarrow as pa

    frame: pd.DataFrame = table.to_pandas()
    for field, column in zip(table.schema, table.columns, strict=True):
        if pa.types.is_integer(field.type) and column.null_count:
            nullable = pd.api.types.pandas_dtype(str(field.type).replace("u", "U").replace("i", "I"))
            frame[field.name] = column.to_pandas(types_mapper={field.type: nullable}.get)
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in table.schema}
    frame.attrs["units"] = {name: unit for name, unit in units.items() if unit}
    return frame


def connect_duckdb(dataset: ReadableDataset, tables: Mapping[str, pa.Table]) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with a view of each table, by stream, and the view ``labels``; see `Dataset.duckdb`."""
    import duckdb
    import pyarrow as pa

    connection = duckdb.connect()
    for stream, table in tables.items():
        connection.register(stream or ONE_TABLE, table)
    names = pa.table({"recording": pa.array(list(dataset.recordings), pa.string())})
    rows = {recording.name: names.slice(index, 1) for index, recording in enumerate(dataset)}
    label_names = [name for name in _names(dataset) if name != "recording"]
    connection.register(
        LABELS_TABLE, pa.concat_tables(add_label_columns(dataset, rows, label_names).values()) if rows else names
    )
    return connection
