"""Messages of one topic on their way to rows: decoded in batches, which are put aside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Int64s
from tacpipe.formats.bags.topic_rows import LOG, PUBLISH, Finished, TopicRows
from tacpipe.io.spill import Spill

BATCH_BYTES = 1 << 24  # of undecoded messages of one topic
BATCH_MESSAGES = 1 << 16
MOST_COLUMNS = 1 << 14  # of a stream


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


class Topic:
    """The messages of one topic on their way to streams; ``aside`` takes their rows."""

    def __init__(self, decoder: Decoder, aside: Spill) -> None:
        self._decoder, self._aside = decoder, aside
        self._messages: list[bytes] = []
        self._log_ns: list[int] = []
        self._publish_ns: list[int] = []
        self._bytes = 0
        self._streams: dict[str, TopicRows] = {}  # by suffix
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
        return [rows.finished(suffix) for suffix, rows in self._streams.items()]

    def _flush(self) -> None:
        if not self._messages:
            return
        log_ns, publish_ns = (_stamps(values) for values in (self._log_ns, self._publish_ns))
        blocks: dict[str, list[Block]] = {}
        for block in self._decoder.blocks(self._messages):
            blocks.setdefault(block.suffix, []).append(block)
        self._messages, self._log_ns, self._publish_ns, self._bytes = [], [], [], 0
        for suffix, several in blocks.items():
            stream = self._streams.setdefault(suffix, TopicRows(self._aside))
            tables = []
            for block in several:
                stamps = {LOG: pa.array(log_ns[block.rows]), PUBLISH: pa.array(publish_ns[block.rows])}
                tables.append(pa.table({**stamps, **block.columns}))
                if stream.describe(block.about) > MOST_COLUMNS:
                    raise TopicError(f"its messages have more than {MOST_COLUMNS} values")
            table = pa.concat_tables(tables, promote_options="permissive")
            rows = np.concatenate([block.rows for block in several])
            if (np.diff(rows) < 0).any():
                table = table.combine_chunks().take(pa.array(np.argsort(rows, kind="stable")))
            try:
                stream.add(table)
            except pa.ArrowException as error:
                raise TopicError("its messages hold values of different types in one place") from error


def _stamps(values: Sequence[int]) -> Int64s:
    try:
        return np.array(values, np.int64)
    except OverflowError:
        raise TopicError("its log times are beyond the year 2262") from None
