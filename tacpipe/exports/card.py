"""Write a dataset card: Parquet files that any tool opens, a README.md and Croissant metadata.

The folder can be uploaded as it is: ``README.md`` is a card of the Hugging Face Hub with one configuration a stream,
``croissant.json`` describes the columns. ``data/STREAM/RECORDING.parquet`` has the rows with native rates and types and a
column ``recording``, ``labels.parquet`` a row a recording.

Example: tacpipe export card data/recordings -o exports/card --license cc-by-4.0 --title "Slides over twenty materials"
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.exports import contents, croissant, readme
from tacpipe.exports.contents import Contents, Loss, shown
from tacpipe.exports.files import Content, Files
from tacpipe.plugins.constraints import Names
from tacpipe.plugins.stage import RecordingName, RecordingOutput, Result, stage
from tacpipe.printable import plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

    Parts = Dataset

LABELS = "labels"
RECORDING = "recording"
UNKNOWN = "unknown"  # the Hub's name for a licence that is not stated
TAGS = ("tactile", "robotics", "timeseries")


@dataclass(frozen=True)
class Params:
    """What the publisher states of the data."""

    title: str = "Tactile recordings"  # heading of the card and name of the dataset
    description: str = ""  # a paragraph
    license: str = ""  # identifier of the licence, as cc-by-4.0
    creators: Names = ""  # who recorded it
    url: str = ""  # where it is published
    published: str = ""  # date, ISO 8601
    cite_as: str = ""  # how to cite it


@stage(version=2)
def part(params: Params, recording: Recording, name: RecordingName) -> Result:
    """Return the Parquet files of one recording, with its name in each row."""
    from tacpipe.io.parquet import to_parquet

    files, losses = {}, []
    for stream in recording.streams:
        table = recording.table(stream)
        files[f"data/{shown(stream)}/{name}.parquet"] = to_parquet(_named(table, name))
        losses += list(_losses(stream, table.schema))
    return Result({"": RecordingOutput(contents.part(recording, losses))}, files)


@stage(version=2, part=part)
def card(params: Params, recordings: Dataset, parts: Parts) -> Result:
    """Write a dataset card: Parquet, README.md, Croissant.

    Rows have native rates and types and a column with the recording's name; the folder can be uploaded as it is.

    Example: tacpipe export card data/recordings -o exports/card --license cc-by-4.0
    """
    found = contents.of_parts(parts)
    patterns = {stream: f"data/{shown(stream)}/*.parquet" for stream in found.streams}
    about = croissant.About(
        name=params.title,
        description=params.description or f"{len(recordings)} recordings of touch, {found.seconds:.0f} s.",
        license=params.license,
        creators=[one.strip() for one in params.creators.split(",") if one.strip()],
        url=params.url,
        published=params.published,
        cite_as=params.cite_as,
    )
    files: dict[str, Content] = {
        readme.NAME: _readme(params, recordings, found, patterns),
        croissant.NAME: croissant.text(about, found, patterns),
        f"{LABELS}.parquet": _labels(recordings),
    }
    differing = [
        f"not alike: stream {shown(one.name)} has other columns in {len(one.others)} recordings than in the first one, so "
        f"readers of all files at once need to unite schemas"
        for one in found.streams.values()
        if one.others
    ]
    licence = [] if params.license else ["no licence is stated: give --license, as cc-by-4.0"]
    return Result(files=Files(files), notes=[*licence, *differing, *readme.notes(recordings, found)])


def _losses(stream: str, schema: pa.Schema) -> Iterator[Loss]:
    """Yield what of a stream the card does not hold."""
    for field in schema:
        if not croissant.type_of(str(field.type)):
            reason = f"{croissant.NAME} has no type for {field.type}; the Parquet files have the column"
            yield Loss(reason, stream, field.name)
    if RECORDING in schema.names:
        yield Loss("the recording's name, as the stream has a column of this name", stream, RECORDING)


def _named(table: pa.Table, name: str) -> pa.Table:
    """Return a table after a first column with the recording's name, but where it has one."""
    import pyarrow as pa

    if RECORDING in table.column_names:
        return table
    return table.add_column(0, pa.field(RECORDING, pa.string()), pa.array([name] * table.num_rows, pa.string()))


def _labels(recordings: Dataset) -> bytes:
    """Return a table with a row a recording and a column an attribute."""
    import pyarrow as pa

    from tacpipe.datasets import frames
    from tacpipe.io.parquet import to_parquet

    rows = {one.name: pa.table({RECORDING: pa.array([one.name], pa.string())}) for one in recordings}
    names = [name for name in dict.fromkeys(name for one in recordings for name in one.attributes) if name != RECORDING]
    return to_parquet(pa.concat_tables(frames.labelled(recordings, rows, names).values()))


def _readme(params: Params, recordings: Dataset, found: Contents, patterns: dict[str, str]) -> bytes:
    front = "\n".join(["---", *_front(params, patterns), "---"])
    parts = [
        front,
        f"# {plain(params.title, 200)}",
        params.description,
        _opening(found),
        *readme.sections(recordings, found),
    ]
    return "\n\n".join(filter(None, parts)).encode() + b"\n"


def _front(params: Params, patterns: dict[str, str]) -> Iterator[str]:
    """Yield the lines of the card's metadata, YAML: a configuration a stream."""
    yield f"license: {json.dumps(params.license or UNKNOWN)}"
    yield f"pretty_name: {json.dumps(params.title)}"
    yield f"tags: {json.dumps(list(TAGS))}"
    yield "configs:"
    for number, (stream, pattern) in enumerate(patterns.items()):
        yield f"- config_name: {json.dumps(shown(stream))}"
        yield f"  data_files: {json.dumps(pattern)}"
        if not number:
            yield "  default: true"
    yield f"- config_name: {LABELS}"
    yield f"  data_files: {LABELS}.parquet"


def _opening(found: Contents) -> str:
    stream = next((shown(one) for one in found.streams), "STREAM")
    return f"""```python
import datasets, duckdb, polars

rows = datasets.load_dataset("FOLDER", "{stream}")["train"]
frame = polars.read_parquet("FOLDER/data/{stream}/*.parquet")
table = duckdb.sql("select * from 'FOLDER/data/{stream}/*.parquet' join 'FOLDER/{LABELS}.parquet' using ({RECORDING})")
```

Each row has the name of its recording. `{croissant.NAME}` describes every column with unit and quantity."""
