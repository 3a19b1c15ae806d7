"""Define a check of recordings and its findings.

A package adds a check with an entry point in the group ``tacpipe.checks`` that refers to a subclass of `Check`. Each
stream is read once, and every check sees it: first the stream, then one channel after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

from tacpipe.channels.schema import is_truth
from tacpipe.io import JsonObject
from tacpipe.io.hashing import digest
from tacpipe.printable import listed

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Indices, Times
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.io.columns import Columns

_SHOWN, _ROWS = 3, 5  # recordings in a line, and rows of each recording in JSON
EXCLUDE = "`tacpipe label DATASET RECORDING --exclude REASON`"
LOADS = ("tactile", "force", "torque", "joint_torque", "static_pressure")
# quantities of columns that no sensor measures
NO_CHANNELS = ("time", "sequence", "mask", "label", "latent", "prediction")


@dataclass(frozen=True)
class CheckFinding:
    """A property of a dataset that is probably not intended."""

    kind: str  # name of the kind, such as equal-stamps
    subject: str  # the stream, column or label concerned
    sentence: str
    repair: str  # the command, option or line of a layout that repairs it
    rows: Mapping[str, Sequence[int]]  # first rows concerned, by recording; none if all are
    content: Sequence[str]  # digests of the data concerned

    @cached_property
    def digest(self) -> str:
        """The digest of what was found in which data; names of recordings do not matter."""
        return digest([self.kind, self.subject, sorted(self.content)])

    @property
    def id(self) -> str:
        """The identifier that ``tacpipe check --accept`` takes."""
        return f"{self.kind}-{self.digest[:8]}"

    def place(self) -> str:
        """Return where it was found, as text: the first recordings with their first row."""
        places = [f"{name} row {rows[0]}" if len(rows) else name for name, rows in self.rows.items()]
        return f"({listed(places, _SHOWN)})" if places else ""

    def to_json(self) -> JsonObject:
        """Return the finding as plain values."""
        rows = {name: [int(row) for row in rows[:_ROWS]] for name, rows in self.rows.items()}
        return {
            "id": self.id,
            "kind": self.kind,
            "subject": self.subject,
            "sentence": self.sentence,
            "repair": self.repair,
            "recordings": rows,
        }


@dataclass(frozen=True)
class StreamName:
    """A stream of a recording by name; checks keep this, because the columns of all recordings do not fit in memory."""

    recording: str
    name: str
    digest: str


@dataclass(frozen=True)
class Stream(StreamName):
    """A stream of the recording under examination."""

    columns: Columns

    @property
    def identity(self) -> StreamName:
        """The stream without its columns."""
        return StreamName(self.recording, self.name, self.digest)

    @cached_property
    def t_ns(self) -> Times | None:
        """Times of the rows (time,), or None without a clock."""
        return self.columns.column("t_ns").to_numpy() if "t_ns" in self.columns.column_names else None

    @cached_property
    def steps_ns(self) -> Times:
        """Differences of successive times (time - 1,); empty without a clock."""
        import numpy as np

        return np.zeros(0, np.int64) if self.t_ns is None else np.diff(self.t_ns)

    def channels(self) -> Iterator[pa.Field]:
        """Yield the fields of the channels: columns that a sensor measured."""
        for column in self.columns.schema:
            if not is_truth(column) and quantity(column) not in NO_CHANNELS:
                yield column


def quantity(column: pa.Field) -> str:
    """Return the quantity of a column."""
    text: str = (column.metadata or {}).get(b"quantity", b"").decode()
    return text


@dataclass
class Occurrence:
    """The rows and values of a kind of finding in one recording."""

    rows: Sequence[int] = ()
    value: float = 0.0  # the largest value of what was measured
    count: int = 0
    channels: list[str] = field(default_factory=list)
    content: set[str] = field(default_factory=set)  # digests of streams


Occurrences = Mapping[str, Occurrence]  # keys are recordings


class Check:
    """A check, which sees every stream and channel of the recordings and then returns its findings."""

    # sentence and repair of each kind, with the fields subject, recordings, channels, cases (their number), worst (the
    # largest value), row (the first one) and usual (the count of the first recording)
    sentences: ClassVar[Mapping[str, tuple[str, str]]] = {}

    def __init__(self) -> None:
        # keys are kind and subject, then recordings
        self.occurrences: dict[tuple[str, str], dict[str, Occurrence]] = {}

    def examine(self, stream: Stream) -> None:
        """Examine the times and columns of a stream."""

    def examine_channel(self, stream: Stream, channel: pa.Field, values: AnyArray) -> None:
        """Examine the values (time,) of a channel, which are floats with NaN if any is missing."""

    def finish(self, recording: str) -> None:
        """Conclude a recording, after all of its streams."""

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the findings, after all recordings."""
        for (kind, subject), occurrences in sorted(self.occurrences.items()):
            yield self.finding(kind, subject, occurrences)

    def note(
        self,
        kind: str,
        stream: StreamName,
        rows: Indices | Sequence[int] = (),
        *,
        value: float = 0.0,
        count: int = 0,
        channel: str = "",
    ) -> None:
        """Remember that a kind of finding occurred in a stream, or in a channel of it."""
        subject = stream.name or "rows"
        occurrence = self.occurrences.setdefault((kind, subject), {}).setdefault(stream.recording, Occurrence())
        occurrence.rows = occurrence.rows or [int(row) for row in rows[:_ROWS]]
        occurrence.value = max(occurrence.value, float(value))
        occurrence.count += count or len(rows)
        occurrence.channels += [channel] if channel else []
        occurrence.content.add(stream.digest)

    def finding(self, kind: str, subject: str, occurrences: Occurrences) -> CheckFinding:
        """Return a finding with the sentence and the repair of its kind."""
        values = list(occurrences.values())
        names = sorted({name for occurrence in values for name in occurrence.channels})
        fields = {
            "subject": subject,
            "worst": max(occurrence.value for occurrence in values),
            "cases": sum(occurrence.count for occurrence in values),
            "recordings": f"{len(values)} recording{'s' * (len(values) > 1)}",
            "channels": f"{len(names)} channel{'s' * (len(names) > 1)} ({listed(names, _SHOWN)})",
            "row": values[0].rows[0] if values[0].rows else 0,
            "usual": values[0].count,
        }
        sentence, repair = (text.format(**fields) for text in self.sentences[kind])
        rows = {name: occurrence.rows for name, occurrence in sorted(occurrences.items())}
        content = [shard for occurrence in values for shard in occurrence.content]
        return CheckFinding(kind, subject, sentence, repair, rows, content)
