"""Messages that are objects, of JSON or protobuf, as columns: a column a path, such as ``pose.position.x``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.formats.bags.topic_rows import HEADER
from tacpipe.formats.bags.topics import Block, TopicError
from tacpipe.printable import plain

MOST_COLUMNS = 4096  # of a message
_STAMPS = ("header.stamp", "timestamp", "stamp")  # in nanoseconds, where they are whole numbers


def block(rows: Sequence[Mapping[str, Any]], types: Mapping[str, pa.DataType]) -> Block:
    """Return messages, each its values by path, as columns; ``types`` are those of paths that a schema declares.

    Raises `TopicError` where they have too many paths.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > MOST_COLUMNS:
        raise TopicError(f"its messages have more than {MOST_COLUMNS} values")
    stamp = next((name for name in _STAMPS if any(isinstance(row.get(name), int) for row in rows)), None)
    columns: dict[str, pa.Array] = {}
    for name in names:
        values = [row.get(name) for row in rows]
        if name == stamp:
            columns[HEADER] = pa.array([value if isinstance(value, int) else 0 for value in values], pa.int64())
        else:
            column = name.replace(".", "_")
            if column in columns:
                raise TopicError(f"its messages have two values that would both be named {plain(column)}")
            columns[column] = _array(values, types.get(name))
    return Block("", np.arange(len(rows)), columns, {name: {} for name in columns if name != HEADER})


def _array(values: Sequence[Any], kind: pa.DataType | None) -> pa.Array:
    try:
        found = pa.array(values, kind)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        numbers = all(isinstance(one, int | float | None) for one in values)
        floats = [None if one is None else float(one) for one in values] if numbers else None
        found = pa.array(floats) if floats else pa.array([None if one is None else str(one) for one in values])
    return pa.array([""] * len(values), pa.string()) if pa.types.is_null(found.type) else found
