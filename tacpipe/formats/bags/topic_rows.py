"""The decoded rows of a topic: put aside batch by batch, then given back in order of the clock that all of them show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.formats.containers.container import Batched, Time
from tacpipe.io import spill
from tacpipe.io.spill import Piece, Spill
from tacpipe.printable import plain

LOG, HEADER, PUBLISH, FRAME = "t_log_ns", "t_header_ns", "t_publish_ns", "frame_id"
APART_NS = 60 * 10**9  # that a header stamp in the same clock is from its log time at most
ABOUT_TIME = {"unit": "ns", "quantity": "time"}


@dataclass(frozen=True)
class Finished:
    """A stream of a topic: its rows in the order of their stamps, and where these are."""

    suffix: str
    content: Batched
    time: Time
    note: str  # what should be known of its stamps; empty: nothing


class TopicRows:
    """The rows of one stream of a topic, of which ``aside`` has all but what is known of them together."""

    def __init__(self, aside: Spill) -> None:
        self._aside = aside
        self._pieces: list[Piece] = []
        self._schema: pa.Schema = pa.schema([])
        self._about: dict[str, Mapping[str, str]] = {}
        self._absent: set[str] = set()  # columns that not every row has
        self._headers_set = self._headers_unset = False
        self._apart_ns = 0  # of header stamps from log times, at most
        self._published_apart = False  # whether a publish time is not the log time
        self._frames: set[str] = set()  # names of frames, two at most

    def describe(self, about: Mapping[str, Mapping[str, str]]) -> int:
        """Take in field metadata by column, where none is there, and return of how many columns there are some."""
        for name, values in about.items():
            self._about.setdefault(name, values)
        return len(self._about)

    def add(self, table: pa.Table) -> None:
        """Put rows aside."""
        names = set(table.column_names)
        if self._pieces:
            self._absent |= names ^ set(self._schema.names)
            self._schema = pa.unify_schemas([self._schema, table.schema], promote_options="permissive")
        else:
            self._schema = table.schema
        self._absent |= {name for name in names if table.column(name).null_count}
        log_ns = table.column(LOG).to_numpy()
        orders = [LOG]
        if HEADER in names and not table.column(HEADER).null_count:
            orders.append(HEADER)
            header_ns = table.column(HEADER).to_numpy()
            self._headers_set |= bool(header_ns.any())
            self._headers_unset |= not header_ns.all()
            self._apart_ns = max(self._apart_ns, int(np.abs(header_ns - log_ns).max(initial=0)))
        self._published_apart |= not table.column(PUBLISH).equals(table.column(LOG))
        if len(self._frames) < 2:
            frames = table.column(FRAME).unique().to_pylist() if FRAME in names else [""]
            self._frames |= {frame or "" for frame in frames}
        self._pieces.append(self._aside.add(table, orders))

    def finished(self, suffix: str) -> Finished:
        """Return the rows in the order of their clock, and which that is."""
        clock, note = self._clock()
        left_out = set() if self._published_apart else {PUBLISH}
        if clock == LOG and HEADER not in self._absent and not self._headers_set:
            left_out.add(HEADER)
        described = {name: dict(values) for name, values in self._about.items()}
        described |= {name: dict(ABOUT_TIME) for name in (LOG, PUBLISH, HEADER)}
        described[clock]["clock"] = "header stamp" if clock == HEADER else "log time"
        if FRAME in self._schema.names and len(self._frames) == 1:
            (frame,) = self._frames
            if frame:
                described[clock]["frame"] = plain(frame)
            left_out.add(FRAME)
        kinds = {one.name: _kind(one.type, one.name in self._absent) for one in self._schema}
        schema = pa.schema(
            [pa.field(name, kind, metadata=described.get(name)) for name, kind in kinds.items() if name not in left_out]
        )

        def read(piece: Piece) -> pa.Table:
            table = self._aside.read(piece)
            return pa.table([_filled(table, one) for one in schema], schema)

        count = sum(piece.rows for piece in self._pieces)
        content = Batched(schema, count, lambda: spill.in_order(self._pieces, read, clock))
        return Finished(suffix, content, Time(clock, "ns"), note)

    def _clock(self) -> tuple[str, str]:
        """Return the column that is the time of the rows, and why where it is not that of the headers.

        A header states when a value was measured, the log when it arrived. Headers count where all are set and in the clock
        of the log: those of a simulation, of a device's own clock or of a clock that was set in between would tear streams
        apart.
        """
        if HEADER not in self._schema.names or HEADER in self._absent:
            return LOG, ""
        if self._headers_unset:
            return LOG, "some header stamps are not set" if self._headers_set else ""
        if self._apart_ns > APART_NS:
            return LOG, f"header stamps are up to {self._apart_ns / 1e9:.3g} s from the log times"
        return HEADER, ""


def _kind(kind: pa.DataType, absent: bool) -> pa.DataType:
    """Return the type of a column that has a value in each row: NaN stands where messages of other shapes leave none."""
    if not absent or pa.types.is_string(kind) or pa.types.is_binary(kind) or pa.types.is_floating(kind):
        return kind
    return pa.float64()


def _filled(table: pa.Table, wanted: pa.Field) -> pa.ChunkedArray:
    """Return a column as it is wanted, without nulls: NaN in numbers, empty in text."""
    if wanted.name not in table.column_names:
        column = pa.chunked_array([pa.nulls(table.num_rows, wanted.type)])
    else:
        column = table.column(wanted.name)
        if pa.types.is_boolean(column.type) and column.type != wanted.type:
            column = column.cast(pa.uint8())
        column = column.cast(wanted.type, safe=False)
    if not column.null_count:
        return column
    if pa.types.is_string(wanted.type):
        return column.fill_null("")
    return column.fill_null(b"" if pa.types.is_binary(wanted.type) else float("nan"))
