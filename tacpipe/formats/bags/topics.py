"""Messages of one topic as tables: decoded in batches, ordered by time, log times kept next to header stamps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Int64s
from tacpipe.formats.containers.container import Time
from tacpipe.printable import plain

BATCH_BYTES = 1 << 26  # of undecoded messages of one topic
BATCH_MESSAGES = 1 << 16
MOST_COLUMNS = 1 << 14  # of a stream
LOG, HEADER, PUBLISH, FRAME = "t_log_ns", "t_header_ns", "t_publish_ns", "frame_id"
APART_NS = 60 * 10**9  # that a header stamp in the same clock is from its log time at most
ABOUT_TIME = {"unit": "ns", "quantity": "time"}


class TopicError(ValueError):
    """Why a topic cannot be read."""


@dataclass(frozen=True)
class Block:
    """Messages of one shape, decoded: which they are, and their columns."""

    suffix: str  # of the stream's name; a message may have rows of several streams
    rows: Int64s  # (row,), positions in the batch
    columns: Mapping[str, pa.Array]
    about: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # field metadata, by column


class Decoder(Protocol):
    """What turns the messages of a topic into columns."""

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages; raises `TopicError` where they cannot be decoded."""


@dataclass(frozen=True)
class Finished:
    """A stream of a topic: its rows in the order of their stamps, and where these are."""

    suffix: str
    table: pa.Table
    time: Time
    note: str  # what should be known of its stamps; empty: nothing


class Topic:
    """The messages of one topic on their way to tables."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._messages: list[bytes] = []
        self._log_ns: list[int] = []
        self._publish_ns: list[int] = []
        self._bytes = 0
        self._tables: dict[str, list[pa.Table]] = {}
        self._about: dict[str, dict[str, Mapping[str, str]]] = {}
        self.count = 0

    def add(self, message: bytes, log_ns: int, publish_ns: int) -> None:
        """Take a message in. Raises `TopicError` where those so far cannot be decoded."""
        self._messages.append(message)
        self._log_ns.append(log_ns)
        self._publish_ns.append(publish_ns)
        self._bytes += len(message)
        self.count += 1
        if self._bytes >= BATCH_BYTES or len(self._messages) >= BATCH_MESSAGES:
            self._flush()

    def finish(self) -> list[Finished]:
        """Return the streams of the topic. Raises `TopicError` where they cannot be decoded."""
        self._flush()
        return [_finished(suffix, tables, self._about[suffix]) for suffix, tables in self._tables.items()]

    def _flush(self) -> None:
        if not self._messages:
            return
        log_ns, publish_ns = (_stamps(values) for values in (self._log_ns, self._publish_ns))
        blocks: dict[str, list[Block]] = {}
        for block in self._decoder.blocks(self._messages):
            blocks.setdefault(block.suffix, []).append(block)
        self._messages, self._log_ns, self._publish_ns, self._bytes = [], [], [], 0
        for suffix, several in blocks.items():
            about = self._about.setdefault(suffix, {})
            tables = []
            for block in several:
                stamps = {LOG: pa.array(log_ns[block.rows]), PUBLISH: pa.array(publish_ns[block.rows])}
                tables.append(pa.table({**stamps, **block.columns}))
                for name, values in block.about.items():
                    about.setdefault(name, values)
                if len(about) > MOST_COLUMNS:
                    raise TopicError(f"its messages have more than {MOST_COLUMNS} values")
            table = pa.concat_tables(tables, promote_options="permissive")
            rows = np.concatenate([block.rows for block in several])
            if (np.diff(rows) < 0).any():
                table = table.combine_chunks().take(pa.array(np.argsort(rows, kind="stable")))
            self._tables.setdefault(suffix, []).append(table)


def _stamps(values: Sequence[int]) -> Int64s:
    try:
        return np.array(values, np.int64)
    except OverflowError:
        raise TopicError("its log times are beyond the year 2262") from None


def _finished(suffix: str, tables: Sequence[pa.Table], about: Mapping[str, Mapping[str, str]]) -> Finished:
    table = pa.concat_tables(tables, promote_options="permissive")
    clock, note = _clock(table)
    stamps = table.column(clock).to_numpy()
    if (np.diff(stamps) < 0).any():
        table = table.combine_chunks().take(pa.array(np.argsort(stamps, kind="stable")))
    columns: dict[str, pa.ChunkedArray] = {name: _filled(table.column(name)) for name in table.column_names}
    if columns[PUBLISH].equals(columns[LOG]):
        del columns[PUBLISH]
    if clock == LOG and HEADER in columns and not np.any(columns[HEADER].to_numpy()):
        del columns[HEADER]
    described = {name: dict(values) for name, values in about.items()}
    described |= {name: dict(ABOUT_TIME) for name in (LOG, PUBLISH, HEADER)}
    described[clock]["clock"] = "header stamp" if clock == HEADER else "log time"
    if FRAME in columns and len(frames := columns[FRAME].unique()) == 1:
        if frames[0].as_py():
            described[clock]["frame"] = plain(frames[0].as_py())
        del columns[FRAME]
    fields = [pa.field(name, column.type, metadata=described.get(name)) for name, column in columns.items()]
    return Finished(suffix, pa.table(list(columns.values()), pa.schema(fields)), Time(clock, "ns"), note)


def _clock(table: pa.Table) -> tuple[str, str]:
    """Return the column that is the time of the rows, and why where it is not that of the headers.

    A header states when a value was measured, the log when it arrived. Headers count where all are set and in the clock of
    the log: those of a simulation, of a device's own clock or of a clock that was set in between would tear streams apart.
    """
    if HEADER not in table.column_names or table.column(HEADER).null_count:
        return LOG, ""
    header_ns, log_ns = table.column(HEADER).to_numpy(), table.column(LOG).to_numpy()
    if not header_ns.all():
        return LOG, "some header stamps are not set" if header_ns.any() else ""
    apart_ns = np.abs(header_ns - log_ns)
    if (apart_ns > APART_NS).any():
        return LOG, f"header stamps are up to {apart_ns.max() / 1e9:.3g} s from the log times"
    return HEADER, ""


def _filled(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column without nulls, which messages of other shapes leave: NaN in numbers, empty in text."""
    if not column.null_count:
        return column
    if pa.types.is_string(column.type):
        return column.fill_null("")
    if pa.types.is_binary(column.type):
        return column.fill_null(b"")
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.uint8())
    wide = column.type if pa.types.is_floating(column.type) else pa.float64()
    return column.cast(wide, safe=False).fill_null(float("nan"))
