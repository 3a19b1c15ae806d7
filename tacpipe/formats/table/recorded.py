"""One recording of a layout, or all that a container holds of one: its streams, attributes, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.errors import TacpipeError
from tacpipe.formats import unique_names
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Contents
from tacpipe.formats.table import rows
from tacpipe.formats.table.columns import TIME
from tacpipe.formats.table.layout import STAMPS, Stream
from tacpipe.formats.table.reading import batches, contained
from tacpipe.plugins.stage import Attribute, Shared
from tacpipe.printable import listed, plain

LOWEST_HZ, HIGHEST_HZ = 0.2, 20_000.0  # rates beyond these are probably stamps in another unit
FEWEST_ROWS = 10  # rows needed to estimate a rate
SKIPPED = "skipped"  # the attribute of a recording that names what could not be read


@dataclass(frozen=True)
class Recorded:
    """What was read of one recording."""

    streams: Mapping[str, pa.Table | pa.RecordBatchReader]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # attributes that containers state
    notes: Sequence[str] = ()  # omissions and missing parts; notes on rates are added as streams are read


def of(
    streams: Sequence[Stream], paths: Mapping[str, Path], within: str | None, shared: Shared | None = None
) -> Recorded:
    """Return the recording whose files are ``paths`` by stream; ``within`` is its name where a file holds many.

    Streams of one container are read in one pass. Raises as `table` does, and for a stream that its container lacks,
    unless it is optional.
    """
    tables: dict[str, pa.Table | pa.RecordBatchReader] = {}
    attributes: dict[str, Attribute] = {}
    notes: list[str] = []
    together: dict[tuple[str, Path], list[Stream]] = {}
    for stream in streams:
        if stream.name not in paths:
            continue
        if stream.contained:
            together.setdefault((str(stream.format), paths[stream.name]), []).append(stream)
        else:
            tables[stream.name] = batches(
                rows.opened(paths[stream.name], stream), stream, within, shared, paths.get(f"{stream.name}{STAMPS}")
            )
    for (kind, path), several in together.items():
        contents = kinds.opened(kind, path).read([one.source for one in several], within)
        stream_by_source = unique_names.by_name(
            ((stream.source, stream) for stream in contents.streams), path, "stream"
        )
        for stream in several:
            if stream.source in stream_by_source:
                tables[stream.name] = contained(path, stream_by_source[stream.source], stream)
            elif not stream.optional:
                raise _lacking(path, stream, contents, kinds.opened(kind, path).look(within))
        attributes |= contents.attributes
        prefixes = tuple(f"{stream.source}/" for stream in several)
        inner = {source: problem for source, problem in contents.skipped.items() if source.startswith(prefixes)}
        notes += [*contents.notes, *_left_out(path, inner)]
    tables = {
        stream.name: _with_rate_noted(tables[stream.name], stream.name, notes)
        for stream in streams
        if stream.name in tables
    }
    return Recorded(tables, attributes, notes)


def _with_rate_noted(
    rows: pa.Table | pa.RecordBatchReader, name: str, notes: list[str]
) -> pa.Table | pa.RecordBatchReader:
    """Return the rows of a stream; as its first ones are read, a rate that no sensor has is added to ``notes``."""
    if isinstance(rows, pa.Table):
        if rows.num_rows:
            _note_rate(rows, name, notes)
        return rows

    def read() -> Iterator[pa.RecordBatch]:
        for number, batch in enumerate(rows):
            if not number:
                _note_rate(batch, name, notes)
            yield batch

    return pa.RecordBatchReader.from_batches(rows.schema, read())


def _note_rate(rows: pa.Table | pa.RecordBatch, name: str, notes: list[str]) -> None:
    measured = [field for field in rows.schema if field.name != TIME and not pa.types.is_string(field.type)]
    step_ns = float(np.median(np.diff(rows.column(TIME).to_numpy()))) if rows.num_rows >= FEWEST_ROWS else 0.0
    if measured and step_ns and not LOWEST_HZ <= 1e9 / step_ns <= HIGHEST_HZ:
        notes.append(
            f"The stamps of {name} are {step_ns / 1e9:g} s apart, {1e9 / step_ns:,.6g} Hz, which few sensors have. Check "
            f"the unit of its time."
        )


def all_of(kind: str, path: Path, within: str | None) -> Recorded:
    """Return all that can be read of a container, or of its episode ``within``; what cannot is named in the notes.

    It is an attribute of the recording too: ``skipped``. Raises `TacpipeError` where nothing can be read.
    """
    contents = kinds.opened(kind, path).read(None, within)
    notes = [*contents.notes, *_left_out(path, contents.skipped)]
    stream_by_name = unique_names.by_name(((stream.name, stream) for stream in contents.streams), path, "stream")
    tables = {
        name: _with_rate_noted(contained(path, stream, Stream(name, source=stream.source)), name, notes)
        for name, stream in stream_by_name.items()
        if stream.rows is None or stream.rows
    }
    if not tables:
        raise TacpipeError(" ".join([f"{path} holds no stream that can be read.", *notes]))
    skipped = "; ".join(f"{plain(one)}: {why}" for one, why in contents.skipped.items())
    return Recorded(tables, {**contents.attributes, **({SKIPPED: skipped} if skipped else {})}, notes)


def _left_out(path: Path, skipped: Mapping[str, str]) -> list[str]:
    return [f"{path}: {plain(source)} is left out: {problem}." for source, problem in skipped.items()]


def _lacking(path: Path, stream: Stream, contents: Contents, look: Contents) -> TacpipeError:
    """Return the error for a stream of a layout that its container does not have."""
    why = contents.skipped.get(stream.source) or look.skipped.get(stream.source)
    if why:
        return TacpipeError(f"{path}: {plain(stream.source)} of [streams.{stream.name}] cannot be read: {why}.")
    return TacpipeError(
        f"{path} has no {plain(stream.source)}, which [streams.{stream.name}] names; it has "
        f"{listed([one.source for one in look.streams], 6)}. Correct source, or set optional = true."
    )
