"""What `tacpipe export mcap` writes beside the messages, so that its files come back as they were.

The metadata of a stream's channel name stream and columns as they were (`tacpipe`, JSON); topics that repeat some columns as
usual messages name the topic that they are derived from. The metadata record `tacpipe` holds the attributes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from tacpipe.formats.bags.topic_rows import HEADER, LOG
from tacpipe.formats.containers.container import Batched, SourceStream, Time
from tacpipe.plugins.stage import Attribute

KEY = "tacpipe"  # of a channel's metadata, and the name of the record


@dataclass(frozen=True)
class Own:
    """A stream as it was before it was exported."""

    stream: str
    derived: bool  # whether the topic only repeats another one
    columns: Mapping[str, tuple[str, Mapping[str, str]]]  # by field of the message: name, metadata
    time: Mapping[str, str]  # metadata of ``t_ns``


def described(metadata: Mapping[str, str]) -> Own | None:
    """Return what the metadata of a channel state of a stream, None where they are not tacpipe's."""
    found = _json(metadata.get(KEY, ""))
    if "derived_from" in found:
        return Own("", True, {}, {})
    try:
        columns = {str(one["field"]): (str(one["name"]), _texts(one["about"])) for one in found["columns"]}
        return Own(str(found["stream"]), False, columns, _texts(found.get("time", {})))
    except (KeyError, TypeError, AttributeError):
        return None


def attributes(values: Mapping[str, str]) -> dict[str, Attribute]:
    """Return the attributes that the metadata record holds."""
    found = _json(values.get("attributes", ""))
    return {str(name): one for name, one in found.items() if one is None or isinstance(one, str | int | float | bool)}


def restored(found: SourceStream, own: Own) -> SourceStream:
    """Return a stream with the names and the metadata that its columns had."""
    fields: dict[str, pa.Field] = {}  # by the column's name so far
    for field in found.schema:
        if field.name in own.columns:
            name, about = own.columns[field.name]
            fields[field.name] = pa.field(name, field.type, metadata=dict(about))
        elif field.name == found.time.column:
            fields[field.name] = pa.field(HEADER, field.type, metadata=dict(own.time))
        elif field.name != LOG:  # that is the same as the header's
            fields[field.name] = field
    schema = pa.schema(list(fields.values()))

    def renamed(table: pa.Table) -> pa.Table:
        return pa.table([table.column(name) for name in fields], schema)

    content = found.content.mapped(schema, renamed) if isinstance(found.content, Batched) else renamed(found.content)
    return SourceStream(found.source, found.name, Time(HEADER, "ns"), content, found.rows)


def _json(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _texts(values: Mapping[str, Any]) -> dict[str, str]:
    return {str(key): str(value) for key, value in values.items()}
