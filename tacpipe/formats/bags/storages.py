"""What a bag's file holds, record by record: topics with their definitions, raw messages, metadata.

All three storages (MCAP, ROS 1 bags, ROS 2's SQLite) are read from their first record on and yield the same things, so what
comes after them knows no difference. What stops a reader early is the last thing that it yields: a `Damage`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np


@dataclass(frozen=True)
class Channel:
    """Who wrote messages to a topic, and how: a topic may have several channels."""

    number: int  # by which messages name it
    topic: str
    type: str  # name of the message type, of the schema
    encoding: str  # of messages: ros1, cdr, json, protobuf, …
    schema_encoding: str  # of the definition: ros1msg, ros2msg, ros2idl, jsonschema, protobuf, …
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
    """Why reading ended early, or what was passed over, as a sentence about the file."""

    text: str


@dataclass
class LostChunk:
    """A chunk whose messages are left out, and what its header and the index behind it state of them."""

    problem: str  # completes the sentence "a chunk …"
    first_ns: int = 0  # log times
    last_ns: int = 0
    count: int = 0  # 0: the file does not state it

    def damage(self, path: Path) -> Damage:
        """Return the note about it."""
        interval = f" from {moment(self.first_ns)} to {moment(self.last_ns)}" if self.last_ns else ""
        count = f"its {self.count:,} messages" if self.count else "its messages, an unknown number,"
        return Damage(f"{path}: a chunk {self.problem}; {count}{interval} are left out.")


def moment(time_ns: int) -> str:
    """Return a time since 1970 as a date, UTC.

    >>> moment(1_700_000_000_000_000_000), moment(2**64 - 1)
    ('2023-11-14T22:13:20.000', '18446744073709551615 ns')
    """
    if not 0 <= time_ns < 2**63:
        return f"{time_ns} ns"
    return str(np.datetime_as_string(np.datetime64(time_ns, "ns"), unit="ms"))


Record: TypeAlias = Channel | Message | Metadata | Damage
