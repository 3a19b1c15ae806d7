"""Write a dataset card: Parquet files that any tool opens, a README.md and Croissant metadata.

The folder can be uploaded without changes: ``README.md`` is a card of the Hugging Face Hub with one configuration per
stream, and ``croissant.json`` describes the columns. ``data/STREAM/RECORDING.parquet`` has the rows with native rates
and types and a column ``recording``; ``labels.parquet`` has one row per recording.

Example: tacpipe export card data/recordings -o exports/card --license cc-by-4.0 --title "Slides over twenty materials"
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.datasets import arrays
from tacpipe.exports import contents
from tacpipe.exports.contents import Column, Contents, Loss, stream_label
from tacpipe.exports.files import README_NAME, Content, Files, loss_notes, sections
from tacpipe.plugins.constraints import Names
from tacpipe.plugins.stage import RecordingName, RecordingOutput, Result, stage
from tacpipe.printable import plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

    Parts = Dataset

NAME = "croissant.json"
CONFORMS = "http://mlcommons.org/croissant/1.0"
_TYPES = {"bool": "sc:Boolean", "string": "sc:Text", "float": "sc:Float", "double": "sc:Float", "halffloat": "sc:Float"}
_TERMS = (  # terms of Croissant's vocabulary
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet", "format"),
    *("includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
    *("repeated", "replace", "samplingRate", "separator", "source", "subField", "transform"),
)
CONTEXT: Mapping[str, str | dict[str, str]] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS},
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "sc": "https://schema.org/",
}


@dataclass(frozen=True)
class About:
    """The publisher's information about the data; empty if unknown."""

    name: str
    description: str
    license: str = ""
    creators: Sequence[str] = ()
    url: str = ""
    published: str = ""  # ISO 8601
    version: str = "1.0.0"
    cite_as: str = ""


def croissant_json(about: About, described: Contents, patterns: Mapping[str, str]) -> bytes:
    """Return ``croissant.json``; ``patterns`` are the path patterns of each stream's files."""
    value = {
        "@context": dict(CONTEXT),
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS,
        "name": about.name,
        "description": about.description,
        "license": about.license,
        "creator": [{"@type": "sc:Organization", "name": name} for name in about.creators],
        "url": about.url,
        "datePublished": about.published,
        "version": about.version,
        "citeAs": about.cite_as,
        "distribution": [_file_set(stream_label(stream), patterns[stream]) for stream in described.streams],
        "recordSet": [_record_set(stream_label(entry.name), entry.columns) for entry in described.streams.values()],
    }
    return (
        json.dumps({key: entry for key, entry in value.items() if entry}, indent=1, ensure_ascii=False).encode() + b"\n"
    )


def _file_set(stream: str, pattern: str) -> dict[str, str]:
    """Return the description of a stream's files in Croissant."""
    return {
        "@type": "cr:FileSet",
        "@id": f"{stream}-files",
        "name": f"{stream}-files",
        "encodingFormat": "application/x-parquet",
        "includes": pattern,
    }


CroissantField = dict[str, str | dict[str, dict[str, str]]]


def _record_set(stream: str, columns: Sequence[Column]) -> dict[str, str | list[CroissantField]]:
    """Return the description of a stream's columns in Croissant, without those of types that it does not support."""
    recording = Column("recording", "string", {"quantity": "name of the recording"})
    described_columns = [
        recording,
        *(column for column in columns if column.name != recording.name and croissant_type(column.type)),
    ]
    ids = column_ids([column.name for column in described_columns])
    return {
        "@type": "cr:RecordSet",
        "@id": stream,
        "name": stream,
        "description": f"Rows of the stream {stream}, of all recordings.",
        "field": [_field(stream, column, ids[column.name]) for column in described_columns],
    }


def column_ids(names: Sequence[str]) -> dict[str, str]:
    """Return a unique identifier for each column, without spaces and brackets, which readers reject.

    >>> column_ids(["taxel01_x", "Force X [N]", "Force X (N)"])
    {'taxel01_x': 'taxel01_x', 'Force X [N]': 'Force_X__N_', 'Force X (N)': 'Force_X__N__2'}
    """
    ids: dict[str, str] = {}
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
        candidate, number = base, 2
        while candidate in ids.values():
            candidate, number = f"{base}_{number}", number + 1
        ids[name] = candidate
    return ids


def _field(stream: str, column: Column, identifier: str) -> CroissantField:
    """Return the description of a column in Croissant."""
    return {
        "@type": "cr:Field",
        "@id": f"{stream}/{identifier}",
        "name": f"{stream}/{identifier}",
        "description": describe_column(column),
        "dataType": croissant_type(column.type),
        "source": {"fileSet": {"@id": f"{stream}-files"}, "extract": {"column": column.name}},
    }


def describe_column(column: Column) -> str:
    """Return a description of a column: quantity, unit, and its other metadata.

    >>> describe_column(Column("taxel01_x", "uint16", {"quantity": "tactile", "unit": "count", "taxel": "1", "axis": "x"}))
    'tactile (count), axis x, taxel 1'
    """
    details = [f"{key} {value}" for key, value in sorted(column.about.items()) if key not in ("quantity", "unit")]
    unit = f" ({column.unit})" if column.unit else ""
    return ", ".join([f"{column.quantity or column.name}{unit}", *details])


def croissant_type(arrow_type: str) -> str:
    """Return the Croissant name of a type, or "" if it has none."""
    return "sc:Integer" if arrow_type.lstrip("u").startswith("int") else _TYPES.get(arrow_type, "")


LABELS = "labels"
RECORDING = "recording"
UNKNOWN = "unknown"  # the Hub's name for an unknown licence
TAGS = ("tactile", "robotics", "timeseries")


@dataclass(frozen=True)
class Params:
    """The publisher's information about the data."""

    title: str = "Tactile recordings"  # heading of the card and name of the dataset
    description: str = ""  # description as one paragraph
    license: str = ""  # identifier of the licence, as cc-by-4.0
    creators: Names = ""  # people who recorded it
    url: str = ""  # address of the publication
    published: str = ""  # date, ISO 8601
    cite_as: str = ""  # full citation


@stage(version=2)
def part(params: Params, recording: Recording, name: RecordingName) -> Result:
    """Return the Parquet files of one recording, with its name in each row."""
    from tacpipe.io.parquet import to_parquet

    files, losses = {}, []
    for stream in recording.streams:
        table = recording.table(stream)
        files[f"data/{stream_label(stream)}/{name}.parquet"] = to_parquet(_add_recording_column(table, name))
        losses += list(_losses(stream, table.schema))
    return Result({"": RecordingOutput(contents.part(recording, losses))}, files)


@stage(version=2)
def card(params: Params, recordings: Dataset, parts: Annotated[Parts, part]) -> Result:
    """Write a dataset card: Parquet, README.md, Croissant.

    Rows have native rates and types, and a column with the name of the recording. The folder can be uploaded unchanged.

    Example: tacpipe export card data/recordings -o exports/card --license cc-by-4.0
    """
    described = contents.contents_from_parts(parts)
    patterns = {stream: f"data/{stream_label(stream)}/*.parquet" for stream in described.streams}
    about = About(
        name=params.title,
        description=params.description or f"{len(recordings)} recordings of touch, {described.seconds:.0f} s.",
        license=params.license,
        creators=[name.strip() for name in params.creators.split(",") if name.strip()],
        url=params.url,
        published=params.published,
        cite_as=params.cite_as,
    )
    files: dict[str, Content] = {
        README_NAME: _readme(params, recordings, described, patterns),
        NAME: croissant_json(about, described, patterns),
        f"{LABELS}.parquet": _labels(recordings),
    }
    differing = [
        f"not alike: stream {stream_label(stream.name)} has other columns in {len(stream.differing)} recordings "
        f"than in the first one, so readers of all files at once need to unite schemas"
        for stream in described.streams.values()
        if stream.differing
    ]
    licence = [] if params.license else ["no licence is stated: give --license, as cc-by-4.0"]
    return Result(files=Files(files), notes=[*licence, *differing, *loss_notes(recordings, described)])


def _losses(stream: str, schema: pa.Schema) -> Iterator[Loss]:
    """Yield what the card cannot represent of a stream: types without an equivalent, and a column named like `RECORDING`."""
    for field in schema:
        if not croissant_type(str(field.type)):
            reason = f"{NAME} has no type for {field.type}; the Parquet files have the column"
            yield Loss(reason, stream, field.name)
    if RECORDING in schema.names:
        yield Loss("the recording's name, as the stream has a column of this name", stream, RECORDING)


def _add_recording_column(table: pa.Table, name: str) -> pa.Table:
    """Return a table with a first column for the recording's name, unless it already has one."""
    import pyarrow as pa

    if RECORDING in table.column_names:
        return table
    return table.add_column(0, pa.field(RECORDING, pa.string()), pa.array([name] * table.num_rows, pa.string()))


def _labels(recordings: Dataset) -> bytes:
    """Return a table with one row per recording and one column per attribute."""
    import pyarrow as pa

    from tacpipe.io.parquet import to_parquet

    rows = {recording.name: pa.table({RECORDING: pa.array([recording.name], pa.string())}) for recording in recordings}
    all_names = dict.fromkeys(name for recording in recordings for name in recording.attributes)
    names = [name for name in all_names if name != RECORDING]
    return to_parquet(pa.concat_tables(arrays.add_label_columns(recordings, rows, names).values()))


def _readme(params: Params, recordings: Dataset, described: Contents, patterns: dict[str, str]) -> bytes:
    """Return the text of README.md: metadata, title, description, an example and the sections of all exports."""
    front = "\n".join(["---", *_front_matter(params, patterns), "---"])
    parts = [
        front,
        f"# {plain(params.title, 200)}",
        params.description,
        _opening_example(described),
        *sections(recordings, described),
    ]
    return "\n\n".join(filter(None, parts)).encode() + b"\n"


def _front_matter(params: Params, patterns: dict[str, str]) -> Iterator[str]:
    """Yield the lines of the card's YAML metadata, with one configuration per stream."""
    yield f"license: {json.dumps(params.license or UNKNOWN)}"
    yield f"pretty_name: {json.dumps(params.title)}"
    yield f"tags: {json.dumps(list(TAGS))}"
    yield "configs:"
    for number, (stream, pattern) in enumerate(patterns.items()):
        yield f"- config_name: {json.dumps(stream_label(stream))}"
        yield f"  data_files: {json.dumps(pattern)}"
        if not number:
            yield "  default: true"
    yield f"- config_name: {LABELS}"
    yield f"  data_files: {LABELS}.parquet"


def _opening_example(described: Contents) -> str:
    """Return a code example that opens the files of the first stream."""
    stream = next((stream_label(name) for name in described.streams), "STREAM")
    return f"""```python
import datasets, duckdb, polars

rows = datasets.load_dataset("FOLDER", "{stream}")["train"]
frame = polars.read_parquet("FOLDER/data/{stream}/*.parquet")
table = duckdb.sql("select * from 'FOLDER/data/{stream}/*.parquet' join 'FOLDER/{LABELS}.parquet' using ({RECORDING})")
```

Each row has the name of its recording. `{NAME}` describes every column with unit and quantity."""
