"""What a bag's file holds, record by record: topics with their definitions, raw messages, metadata.

All three storages (MCAP, ROS 1 bags, ROS 2's SQLite) are read from their first record on and yield the same things, so what
comes after them knows no difference. What stops a reader early is the last thing that it yields: a `Damage`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias


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


Record: TypeAlias = Channel | Message | Metadata | Damage
