"""Recordings and their labels as frames: pandas, and a DuckDB connection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.datasets import selection
from tacpipe.errors import UsageError
from tacpipe.printable import plain

if TYPE_CHECKING:
    import duckdb
    import pandas as pd
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Attribute

ONE_TABLE, LABELS = "data", "labels"  # views of `connected`


def labels(dataset: Dataset) -> pd.DataFrame:
    """Return the attributes of the recordings: one row a recording (index ``recording``), one column an attribute.

    Integers and booleans that some recordings lack are pandas' nullable types; else a column has the type of its values.
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


def _names(dataset: Dataset) -> list[str]:
    """Return the names of all attributes, in the order in which recordings have them."""
    return list(dict.fromkeys(name for recording in dataset for name in recording.attributes))


def labelled(
    dataset: Dataset, tables: Mapping[str, pa.Table], names: Sequence[str] | None = None
) -> dict[str, pa.Table]:
    """Return the tables of recordings with one more column per attribute: all (None) or those in ``names``.

    A recording without an attribute has nulls there. Raises `UsageError` for an attribute that no recording has, and for
    one that shares its name with a column.
    """
    import pyarrow as pa

    existing = _names(dataset)
    chosen = existing if names is None else list(dict.fromkeys(names))
    for name in chosen:
        if name not in existing:
            raise selection.unknown_label(dataset, name)
        if any(name in table.column_names for table in tables.values()):
            addable = [label for label in existing if not any(label in table.column_names for table in tables.values())]
            raise UsageError(
                f"{plain(name)} is a label and a column of the recordings. Name the labels to add, as labels={addable!r}."
            )
    labelled_tables = {}
    kinds = {name: _kind([dataset[recording].attributes.get(name) for recording in tables]) for name in chosen}
    for recording, table in tables.items():
        for name in chosen:
            value = pa.scalar(_as(dataset[recording].attributes.get(name), kinds[name]), kinds[name])
            table = table.append_column(name, pa.repeat(value, table.num_rows))
        labelled_tables[recording] = table
    return labelled_tables


def _kind(values: Sequence[Attribute]) -> pa.DataType:
    """Return the arrow type that holds all of these values: text where they are of several kinds."""
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
    """Return an arrow table as a frame in which integers with nulls are pandas' nullable integers."""
    import pandas as pd
    import pyarrow as pa

    frame: pd.DataFrame = table.to_pandas()
    for field, column in zip(table.schema, table.columns, strict=True):
        if pa.types.is_integer(field.type) and column.null_count:
            nullable = pd.api.types.pandas_dtype(str(field.type).replace("u", "U").replace("i", "I"))
            frame[field.name] = column.to_pandas(types_mapper={field.type: nullable}.get)
    return frame


def connected(dataset: Dataset) -> duckdb.DuckDBPyConnection:
    """Return a DuckDB connection with one view per stream and the view ``labels``; see `Dataset.duckdb`."""
    import duckdb
    import pyarrow as pa

    connection = duckdb.connect()
    for stream in sorted({stream for recording in dataset for stream in recording.streams}):
        having = dataset.only(recording.name for recording in dataset if stream in recording.streams)
        connection.register(stream or ONE_TABLE, having.table(stream))
    names = pa.table({"recording": pa.array(list(dataset.recordings), pa.string())})
    rows = {recording.name: names.slice(place, 1) for place, recording in enumerate(dataset)}
    label_names = [name for name in _names(dataset) if name != "recording"]
    connection.register(LABELS, pa.concat_tables(labelled(dataset, rows, label_names).values()) if rows else names)
    return connection
