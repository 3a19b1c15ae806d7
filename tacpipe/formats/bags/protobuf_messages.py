"""Protobuf messages of an MCAP file, by the descriptors that their schema holds."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from tacpipe.formats.bags import paths
from tacpipe.formats.bags.topics import Block, TopicError
from tacpipe.printable import plain

TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_TYPES = {  # of a field's descriptor, by the number of its kind in C++
    **{1: pa.int32(), 2: pa.int64(), 3: pa.uint32(), 4: pa.uint64(), 5: pa.float64(), 6: pa.float32(), 7: pa.bool_()},
    8: pa.int32(),  # of an enumeration
}
_MESSAGE, _TEXT, _BYTES = 10, 9, 12


@dataclass(frozen=True)
class Protobuf:
    """The messages of a topic of a protobuf type; ``schema`` is a set of file descriptors."""

    name: str
    schema: bytes

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages; raises `TopicError` where they are not of the type."""
        from google.protobuf.message import DecodeError

        types: dict[str, pa.DataType] = {}
        rows = []
        for message in messages:
            try:
                rows.append(flat(self._class.FromString(message), types))
            except (DecodeError, RecursionError) as error:
                raise TopicError(f"a message is not a {plain(self.name)}") from error
        yield paths.block(rows, types)

    @functools.cached_property
    def _class(self) -> Any:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
        from google.protobuf.message import DecodeError

        try:
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(self.schema).file:
                pool.Add(file)
            found = pool.FindMessageTypeByName(self.name)
            return message_factory.GetMessageClass(found)
        except (DecodeError, KeyError, TypeError, ValueError) as error:
            raise TopicError(f"the file has no definition of its type {plain(self.name)}") from error


def flat(message: Any, types: dict[str, pa.DataType], before: str = "") -> dict[str, Any]:
    """Return a message as values by path, all fields without presence too; the types of numbers are added to ``types``."""
    found: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        path = f"{before}{field.name}"
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            several = {f"{path}.{key}": value[key] for key in sorted(value, key=str)}
            field = field.message_type.fields_by_name["value"]
        elif field.is_repeated:
            several = {f"{path}.{position}": one for position, one in enumerate(value)}
        elif field.has_presence and not message.HasField(field.name):
            continue
        else:
            several = {path: value}
        for name, one in several.items():
            if field.cpp_type != _MESSAGE:
                found[name] = one
                types[name] = pa.binary() if field.type == _BYTES else _TYPES.get(field.cpp_type, pa.string())
            elif field.message_type.full_name in TIMES:
                found[name] = one.seconds * 10**9 + one.nanos
                types[name] = pa.int64()
            else:
                found |= flat(one, types, f"{name}.")
    return found
