"""The streams of a recording, whether they lie apart, as recorded, or side by side in one synchronized table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from tacpipe.channels.streams import EVENTS, TRUTH

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

NO_SIGNALS = (EVENTS, "truth")  # streams of what went wrong, and of what a simulation knows


def describe_streams(streams: Sequence[str]) -> str:
    """Return the predicate of a sentence about a recording with these streams.

    >>> describe_streams(["robot", "skin"]), describe_streams([""])
    ('has the streams robot, skin', 'is one table, not separate streams')
    """
    return "is one table, not separate streams" if tuple(streams) == ("",) else f"has the streams {', '.join(streams)}"


def streams_of(recording: Recording) -> dict[str, pa.Table]:
    """Return the table of each stream, under the names that its columns had when they were recorded.

    Ground truth and the masks of a synchronized table are left out.
    """
    return split_tables({name: recording.table(name) for name in recording.streams if name not in NO_SIGNALS})


def split_tables(tables: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    """Return the table of each stream of a recording as `streams_of` does, from the tables as they are stored."""
    if set(tables) != {""}:
        return {name: table for name, table in tables.items() if name not in NO_SIGNALS}
    table = tables[""]
    return {
        stream: table.select(list(names.values())).rename_columns(list(names))
        for stream, names in stored_columns(table.schema).items()
    }


def stored_columns(schema: pa.Schema) -> dict[str, dict[str, str]]:
    """Return the columns of each stream of a synchronized table: recorded name to stored name, times first."""
    columns: dict[str, dict[str, str]] = {}
    for field in schema:
        metadata = field.metadata or {}
        signal = field.name != "t_ns" and not field.name.startswith(TRUTH) and metadata.get(b"quantity") != b"mask"
        if signal:
            stream = metadata.get(b"stream", b"").decode()
            columns.setdefault(stream, {"t_ns": "t_ns"})[_recorded(field.name, stream)] = field.name
    return columns


def _recorded(name: str, stream: str) -> str:
    return name.removeprefix(f"{stream}_") if stream else name
