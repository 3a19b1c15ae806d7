"""Records that the files of a bag hold: topics with their definitions, raw messages, metadata.

The readers of all three storages (MCAP, ROS 1 bags, ROS 2's SQLite) start at the first record and yield the same types.
A reader that stops early yields a `Damage` last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

CUT_OFF = "the file ends within a record: it was cut off, and what came after is missing"


class BrokenRecordError(Exception):
    """A record that cannot be read; the message is a clause with the reason."""


@dataclass(frozen=True)
class Channel:
    """A source of messages of one topic with their type and encoding; a topic may have several channels."""

    number: int  # identifies the channel in messages
    topic: str
    type: str  # name of the message type, of the schema
    encoding: str  # encoding of messages: ros1, cdr, json, protobuf, …
    schema_encoding: str  # encoding of the definition: ros1msg, ros2msg, ros2idl, jsonschema, protobuf, …
    schema: bytes
    metadata: Mapping[str, str] = field(default_factory=dict)


class Message(NamedTuple):  # there are millions, and a dataclass takes three times as long to make
    """A message as it was written."""

    channel: int
    log_ns: int
    publish_ns: int
    content: bytes


@dataclass(frozen=True)
class Metadata:
    """Texts by name that the file states of itself."""

    name: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class Damage:
    """A sentence about the file with the reason why reading ended early, or with the part that was not read."""

    text: str


@dataclass
class LostChunk:
    """A chunk whose messages are left out, with what its header and its index state about them."""

    problem: str  # completes the sentence "a chunk …"
    first_ns: int = 0  # log times
    last_ns: int = 0
    count: int = 0  # 0: the file does not state it

    def damage(self, path: Path) -> Damage:
        """Return the note about it."""
        interval = f" from {format_time(self.first_ns)} to {format_time(self.last_ns)}" if self.last_ns else ""
        count = f"its {self.count:,} messages" if self.count else "its messages, an unknown number,"
        return Damage(f"{path}: a chunk {self.problem}; {count}{interval} are left out.")


def format_time(time_ns: int) -> str:
    """Return a time since 1970 as a date, UTC.

    >>> format_time(1_700_000_000_000_000_000), format_time(2**64 - 1)
    ('2023-11-14T22:13:20.000', '18446744073709551615 ns')
    """
    if not 0 <= time_ns < 2**63:
        return f"{time_ns} ns"
    return str(np.datetime_as_string(np.datetime64(time_ns, "ns"), unit="ms"))


Record: TypeAlias = Channel | Message | Metadata | Damage
