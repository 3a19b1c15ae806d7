"""Account for the rows that a stage read: each was used, or is counted under the reason why it was not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.io import Json

if TYPE_CHECKING:
    from tacpipe.arrays import Bools

OUTSIDE = "outside the common time"  # rows before all streams have started, or after the last row
DUPLICATE = "received before"
LATE = "late"  # a sample that precedes one already received
MERGED = "merged"  # several samples became one row
IN_GAP = "in a gap or without a value"
NO_CONTACT = "without contact"
NO_WINDOW = "in no window"  # too close to a gap, a contact's end or the recording's end
NO_LABEL = "without a label"
NO_IMAGE = "without a sound frame of each camera"
MARKED = "marked"  # the time of the sample is uncertain
MEASURED = "already measured"  # the next sample had arrived together with this one
UNNEEDED = "in streams that are not needed"
OUTSIDE_FRACTION = 0.01  # minimum fraction of a stream's rows outside the common time that is mentioned


@dataclass(frozen=True)
class RowCounts:
    """Rows of one stream: all that a stage read, those that it used, and the others by reason.

    A row is used if it is in the result, or values in the result are computed from it. A held sample within the common
    time is used, although a newer one replaced it before the next row.

    >>> RowCounts(10, 7, {LATE: 3, MERGED: 0}) + RowCounts.all_used(5)
    RowCounts(read=15, used=12, unused={'late': 3})
    """

    read: int
    used: int
    unused: Mapping[str, int] = field(default_factory=dict)  # rows by reason; reasons without rows are dropped

    def __post_init__(self) -> None:
        """Raise `TacpipeError` if the used and the unused rows are not all rows that were read."""
        if self.used + sum(self.unused.values()) != self.read or min(self.used, *self.unused.values(), 0) < 0:
            raise TacpipeError(
                f"Of {self.read} rows, {self.used} were used and {dict(self.unused)} were not, which does not add up. "
                f"The stage must count each row that it read once."
            )
        integers = {"read": int(self.read), "used": int(self.used)}  # instead of those of numpy
        unused = {reason: int(rows) for reason, rows in self.unused.items() if rows}
        self.__dict__.update(integers, unused=unused)

    @classmethod
    def all_used(cls, read: int) -> RowCounts:
        """Return the counts of a stream of which every row was used."""
        return cls(read, read)

    @classmethod
    def some_used(cls, read: int, used: int, reason: str) -> RowCounts:
        """Return the counts of a stream whose unused rows have one reason."""
        return cls(read, used, {reason: read - used})

    @classmethod
    def from_masks(cls, used: Bools, unused: Sequence[tuple[str, Bools]], otherwise: str = NO_WINDOW) -> RowCounts:
        """Return the counts of rows (row,) that are ``used``; others have the first reason whose mask applies."""
        remaining, rows_by_reason = ~used, {}
        for reason, mask in unused:
            rows_by_reason[reason] = int((mask & remaining).sum())
            remaining = remaining & ~mask
        return cls(len(used), int(used.sum()), {**rows_by_reason, otherwise: int(remaining.sum())})

    def __add__(self, other: RowCounts) -> RowCounts:
        return RowCounts(self.read + other.read, self.used + other.used, Counter(self.unused) + Counter(other.unused))

    def __sub__(self, other: RowCounts) -> RowCounts:
        unused = Counter(self.unused)
        unused.subtract(other.unused)
        return RowCounts(self.read - other.read, self.used - other.used, unused)


StreamRows = Mapping[str, RowCounts]  # counts by stream; "" is a recording of a single table


@dataclass
class StageRows:
    """The rows that a stage read for several results, by stream. Results of older versions have no counts."""

    results: int = 0  # number of results with counts
    streams: dict[str, RowCounts] = field(default_factory=dict)

    @classmethod
    def from_json(cls, value: Json) -> StageRows:
        """Return the rows that `to_json` returned."""
        return cls(value["results"], {stream: RowCounts(**counts) for stream, counts in value["streams"].items()})

    def to_json(self) -> Json:
        """Return the rows as JSON, as records have them."""
        return asdict(self)

    def add(self, other: StageRows) -> None:
        """Add the rows of other results of the stage."""
        self.results += other.results
        for stream, counts in other.streams.items():
            self.streams[stream] = self.streams.get(stream, _NO_ROWS) + counts

    def subtract(self, other: StageRows) -> None:
        """Subtract the rows of some of these results."""
        self.results -= other.results
        for stream, counts in other.streams.items():
            self.streams[stream] -= counts

    def describe_unused(self, stage: str) -> str:
        """Return a sentence on the unused rows, or an empty string if there are none worth a warning.

        Rows outside the common time are mentioned from `OUTSIDE_FRACTION` of a stream's rows.

        >>> StageRows(1, {"arm": RowCounts(9, 8, {LATE: 1}), "skin": RowCounts(5, 2, {LATE: 3})}).describe_unused("train")
        'train used 10 of 14 rows; 4 late (arm 1, skin 3).'
        """
        by_reason: dict[str, dict[str, int]] = {}
        for stream, counts in sorted(self.streams.items()):
            for reason, rows in counts.unused.items():
                if reason != OUTSIDE or rows >= OUTSIDE_FRACTION * counts.read:
                    by_reason.setdefault(reason, {})[stream] = rows
        parts: list[str] = []
        for reason, rows_by_stream in by_reason.items():
            named = ", ".join(f"{stream} {rows:,}" for stream, rows in rows_by_stream.items() if stream)
            parts.append(f"{sum(rows_by_stream.values()):,} {reason}{f' ({named})' if named else ''}")
        used, read = (sum(getattr(counts, name) for counts in self.streams.values()) for name in ("used", "read"))
        return f"{stage} used {used:,} of {read:,} rows; {', '.join(parts)}." if parts else ""


def table_of_rows(stages: Mapping[str, Json]) -> list[list[str]]:
    """Return a row of text for each stage and stream: stage, stream, rows read and used, and unused rows by reason.

    >>> table_of_rows({"synchronize": StageRows(1, {"arm": RowCounts(9, 8, {LATE: 1})}).to_json()})
    [['synchronize', 'arm', '9', '8', '1 late']]
    """
    return [
        [
            stage.removesuffix(".part"),
            stream or "-",
            f"{counts.read:,}",
            f"{counts.used:,}",
            ", ".join(f"{rows:,} {reason}" for reason, rows in counts.unused.items()),
        ]
        for stage, stage_rows in stage_rows_from_json(stages).items()
        for stream, counts in sorted(stage_rows.streams.items())
    ]


TABLE_HEADS = ("stage", "stream", "rows read", "used", "not used")


def stage_rows_from_json(value: Mapping[str, Json] | None) -> dict[str, StageRows]:
    """Return the rows of each stage in a record; older records have none."""
    return {stage: StageRows.from_json(rows) for stage, rows in (value or {}).items()}


_NO_ROWS = RowCounts(0, 0)


@dataclass
class RowTally:
    """The streams that a stage opened, and what `count_rows` and `drop_rows` stated while it ran."""

    opened: dict[tuple[str, str], int] = field(default_factory=dict)  # number of rows
    counts: dict[tuple[str, str], RowCounts] = field(default_factory=dict)
    dropped: dict[str, dict[str, int]] = field(default_factory=dict)  # rows of files, by stream and reason


_tally: ContextVar[RowTally | None] = ContextVar("row_tally", default=None)


@contextmanager
def tally_rows() -> Iterator[RowTally]:
    """Collect the streams opened and the rows counted within the block."""
    tally = RowTally()
    token = _tally.set(tally)
    try:
        yield tally
    finally:
        _tally.reset(token)


def note_opened(recording: str, stream: str, rows: int) -> None:
    """Note for the running stage that it opened a stream."""
    if (tally := _tally.get()) is not None:
        tally.opened[recording, stream] = rows


def count_rows(recording: str, stream: str, counts: RowCounts) -> None:
    """State for the running stage over whole datasets which rows of a stream it used; a later statement replaces it."""
    if (tally := _tally.get()) is not None:
        tally.counts[recording, stream] = counts


def drop_rows(stream: str, reason: str, rows: int) -> None:
    """State for the running reader of files that rows of a stream are not in its result. Calls add up."""
    if (tally := _tally.get()) is not None:
        by_reason = tally.dropped.setdefault(stream, {})
        by_reason[reason] = by_reason.get(reason, 0) + rows
