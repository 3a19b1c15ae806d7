"""Write recordings as CSV files, one per stream, with a layout file that reads them back.

`tacpipe ingest table EXPORT --layout EXPORT/layout.toml` restores the same streams: bit-identical values and
timestamps, types, units, quantities and labels. ``layout.toml`` describes each column; ``labels.json`` contains the
attributes of each recording.

Example: tacpipe export csv data/recordings -o exports/csv
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from tacpipe.exports import contents
from tacpipe.exports.contents import TIME, Contents, ExportStream, Loss, stream_label
from tacpipe.exports.files import README_NAME, Content, Files, loss_notes, readme_text
from tacpipe.plugins.stage import RecordingName, RecordingOutput, Result, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.io.columns import Columns

    Parts = Dataset

LAYOUT, LABELS = "layout.toml", "labels.json"
TYPES = {"float": "float32", "double": "float64", "string": "text"}  # Arrow types that have another name in a layout
READ = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "float", "double", "bool", "string")
_OPENING = f"""
One CSV file a stream, in a folder a recording. `{TIME}` is the time in nanoseconds of UTC. tacpipe reads them back with
types, units and labels:

```sh
tacpipe ingest table EXPORT --layout EXPORT/{LAYOUT} -o data/recordings
```

From Python: `pandas.read_csv("EXPORT/RECORDING/STREAM.csv")`.
"""


@dataclass(frozen=True)
class Params:
    """CSV has no options."""


@stage(version=2)
def part(params: Params, recording: Recording, name: RecordingName) -> Result:
    """Return one file per stream."""
    writers: dict[str, Callable[[Any], object]] = {}
    losses: list[Loss] = []
    for stream in recording.streams:
        stored = recording.columns(stream)
        losses += list(_losses(stream, stored))
        writers[f"{name}/{stream_label(stream)}.csv"] = functools.partial(_write_csv, stored)
    return Result({"": RecordingOutput(contents.part(recording, losses))}, written=writers)


@stage(version=2)
def csv(params: Params, recordings: Dataset, parts: Annotated[Parts, part]) -> Result:
    """Write recordings as CSV files that can be read back.

    One file per stream. `tacpipe ingest table EXPORT --layout EXPORT/layout.toml` restores values, stamps, types, units
    and labels.

    Example: tacpipe export csv data/recordings -o exports/csv
    """
    described = contents.contents_from_parts(parts)
    files: dict[str, Content] = {
        f"{recording.name}/{LABELS}": json.dumps(dict(recording.attributes), indent=1, sort_keys=True).encode() + b"\n"
        for recording in recordings
    }
    files[LAYOUT] = layout_text(described).encode()
    files[README_NAME] = readme_text("Tactile recordings as CSV", _OPENING, recordings, described)
    return Result(files=Files(files), notes=loss_notes(recordings, described))


def layout_text(described: Contents) -> str:
    """Return the layout file with which an export can be read back."""
    lines = ["# Reads these files back: tacpipe ingest table FOLDER --layout FOLDER/layout.toml -o data/recordings"]
    lines += ["", "[recordings]", 'name = "{recording}"']
    count = max((len(stream.recordings) for stream in described.streams.values()), default=0)
    for stream in described.streams.values():
        if any(column.name == TIME for column in stream.columns):
            lines += _stream_lines(stream, optional=len(stream.recordings) < count)
    return "\n".join([*lines, "", "[[labels]]", f'file = "{{recording}}/{LABELS}"', ""])


def _stream_lines(stream: ExportStream, *, optional: bool) -> Iterator[str]:
    """Yield the lines of a ``[streams.NAME]`` entry of the layout."""
    yield ""
    yield f"[streams.{stream_label(stream.name)}]"
    yield f"files = {json.dumps(f'{{recording}}/{stream_label(stream.name)}.csv')}"
    yield f'time = {{ column = "{TIME}", unit = "ns" }}'
    if optional:
        yield "optional = true"
    if stream.nan:
        yield 'missing = ["nan"]'
    yield "columns = ["
    for column in stream.columns:
        if column.name == TIME:
            continue
        if column.type not in READ:
            yield f"    {{ match = {_quote(column.name)}, skip = true }},"
            continue
        entries = {"match": _quote(column.name), "type": _quote(TYPES.get(column.type, column.type))}
        entries |= {key: _quote(column.about[key]) for key in ("quantity", "unit", "component") if key in column.about}
        extra_metadata = {
            key: value for key, value in column.about.items() if key not in ("quantity", "unit", "component")
        }
        if extra_metadata:
            entries["about"] = (
                f"{{ {', '.join(f'{_quote(key)} = {_quote(value)}' for key, value in extra_metadata.items())} }}"
            )
        yield f"    {{ {', '.join(f'{key} = {value}' for key, value in entries.items())} }},"
    yield "]"


def _quote(value: str) -> str:
    return json.dumps(value, ensure_ascii=True)  # the same syntax as a basic string in TOML


def _write_csv(stored: Columns, sink: Any) -> None:
    """Write a stream as CSV: floats with the fewest digits that restore the same bits, NaN as ``nan``."""
    import pyarrow.csv as pc

    with pc.CSVWriter(sink, _writable_table(stored.schema.empty_table()).schema) as writer:
        for table in stored.batches():
            writer.write_table(_writable_table(table))


def _writable_table(table: pa.Table) -> pa.Table:
    """Return a table whose columns can be written, without metadata."""
    import pyarrow as pa

    return pa.Table.from_arrays([_writable_column(column) for column in table.columns], names=table.column_names)


def _writable_column(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column in a writable form: bytes as hex digits, other unsupported types as text."""
    import pyarrow as pa

    if pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type):
        return pa.chunked_array(
            [pa.array([None if value is None else value.hex() for value in column.to_pylist()], pa.string())]
        )
    if pa.types.is_nested(column.type):
        return pa.chunked_array([pa.array([json.dumps(value) for value in column.to_pylist()], pa.string())])
    return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column


def _losses(stream: str, table: Columns) -> Iterator[Loss]:
    """Yield what CSV and the layout cannot represent of a stream."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if not stream:
        yield Loss("that the recordings are one table of several streams: they are read back as one stream, data")
    if TIME not in table.column_names:
        yield Loss(f"it has no time, so {LAYOUT} leaves it out", stream)
        return
    about: Mapping[str, str] = contents.field_metadata(table.schema.field(TIME))
    if "made" in about:
        yield Loss(f"how its stamps were made ({about['made']})", stream)
    for field in table.schema:
        column = table.column(field.name)
        if str(field.type) not in READ:
            yield Loss(f"{LAYOUT} leaves out the type {field.type}", stream, field.name)
        elif column.null_count and not pa.types.is_string(field.type):
            yield Loss("missing values are empty cells, which ingest refuses or reads as NaN", stream, field.name)
        elif pa.types.is_floating(field.type) and bool(np.isinf(column.to_numpy()).any()):
            yield Loss("it has infinite values, which ingest refuses", stream, field.name)
        elif pa.types.is_string(field.type) and pc.any(pc.match_substring_regex(column, r"[\r\n]")).as_py():
            yield Loss("its text has line ends, which ingest refuses", stream, field.name)
