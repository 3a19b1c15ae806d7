"""A file of many recordings, cut into their rows once: recordings that are read one by one then read only their own.

The cut is a file of Arrow's record batches (https://arrow.apache.org/docs/format/Columnar.html), one for each recording in a
block, followed by an index in JSON and the index's length in eight bytes.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Indices
from tacpipe.io import regular
from tacpipe.io.drafts import Hashed
from tacpipe.io.parquet import owned

ROW = "row"  # the last column: of which row in the file each is
_LENGTH = 8  # bytes


def cut(blocks: Iterator[pa.Table], recording: str, draft: Hashed) -> None:
    """Write the rows of ``blocks`` to ``draft``, apart for each recording that the column ``recording`` names."""
    places: dict[str, list[tuple[int, int]]] = {}
    schema, begun = None, 0
    for block in blocks:
        for name, rows in _apart(block, recording, begun):
            schema = rows.schema
            for batch in rows.combine_chunks().to_batches():
                content = memoryview(batch.serialize())
                places.setdefault(name, []).append((draft.tell(), len(content)))
                draft.write(content)
        begun += block.num_rows
    described = "" if schema is None else base64.b64encode(schema.serialize().to_pybytes()).decode()
    index = json.dumps({"schema": described, "places": places}).encode()
    draft.write(index)
    draft.write(len(index).to_bytes(_LENGTH, "little"))


def rows(path: Path, recording: str) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the rows of one recording of a `cut`, block by block, and which rows of the file they were."""
    with regular.failing(path), regular.opened(path, follow=False) as file:
        file.seek(-_LENGTH, 2)
        length = int.from_bytes(file.read(_LENGTH), "little")
        file.seek(-_LENGTH - length, 2)
        index: Mapping[str, Any] = json.loads(file.read(length))
        for place, size in index["places"].get(recording, ()):
            file.seek(place)
            schema = pa.ipc.read_schema(owned(base64.b64decode(index["schema"])))
            table = pa.Table.from_batches([pa.ipc.read_record_batch(owned(file.read(size)), schema)])
            yield table.drop_columns([ROW]), table.column(table.num_columns - 1).to_numpy()


def _apart(block: pa.Table, recording: str, begun: int) -> Iterator[tuple[str, pa.Table]]:
    """Yield the rows of each recording in a block, in their order."""
    column = block.column(recording).cast(pa.string()).combine_chunks().dictionary_encode()
    codes, names = column.indices.fill_null(-1).to_numpy(zero_copy_only=False), column.dictionary.to_pylist()
    order = np.argsort(codes, kind="stable")
    whole = [block.column(name) for name in block.column_names]
    plain = [one.cast(one.type.value_type) if pa.types.is_dictionary(one.type) else one for one in whole]
    made = pa.Table.from_arrays([*plain, pa.array(np.arange(begun, begun + len(block)))], [*block.column_names, ROW])
    if (np.diff(codes) < 0).any():  # else each recording's rows lie together, and nothing is copied
        made = made.take(pa.array(order))
    edges = np.searchsorted(codes[order], np.arange(len(names) + 1))
    for name, start, stop in zip(names, edges, edges[1:], strict=False):
        yield name, made.slice(start, stop - start)
