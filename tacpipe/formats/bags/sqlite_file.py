"""Read the records of a ROS 2 bag's SQLite file (.db3)."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags import ros
from tacpipe.formats.bags.storages import Channel, Damage, Message, Metadata, Record
from tacpipe.io import regular
from tacpipe.printable import plain

_ERRORS = (sqlite3.Error, UnicodeDecodeError)  # the second where a message of SQLite quotes damaged text
MAGIC = b"SQLite format 3\0"


def read_records(path: Path) -> Iterator[Record]:
    """Yield the records of a file in the order in which they were written. Raises `TacpipeError` where it is no bag."""
    with regular.failing(path), regular.opened(path) as file:
        magic = file.read(len(MAGIC))
    if magic != MAGIC:
        raise TacpipeError(f"{path} is not a SQLite file: it {'does not begin as one' if magic else 'is empty'}.")
    with _connect(path) as connection:
        try:
            _expect_tables(path, connection)
            yield from _read_channels(connection)
        except _ERRORS as error:
            raise TacpipeError(f"{path} is not a bag of ROS 2: {plain(str(error), 120)}.") from error
        try:
            for number, log_ns, content in connection.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if not (isinstance(number, int) and isinstance(log_ns, int) and isinstance(content, bytes)):
                    yield Damage(f"{path} is damaged (a message has no time or no bytes): what came after is missing.")
                    return
                yield Message(number, log_ns, log_ns, content)
        except _ERRORS as error:
            yield Damage(f"{path} is damaged ({plain(str(error), 120)}): what came after is missing.")


@contextlib.contextmanager
def _connect(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file without changing it; what was not yet moved from its log (-wal) is read from a copy."""
    log = regular.inside(path.parent, f"{path.name}-wal")
    with tempfile.TemporaryDirectory() if log.is_file() and log.stat().st_size else contextlib.nullcontext() as copies:
        if copies is None:
            address = f"file:{quote(str(path.absolute()))}?immutable=1"
        else:
            for source in (path, log):
                shutil.copy(source, copies)
            address = f"file:{quote(str(Path(copies, path.name)))}"
        connection = sqlite3.connect(address, uri=True)
        connection.text_factory = lambda content: content.decode(errors="replace")
        try:
            yield connection
        finally:
            connection.close()


def _expect_tables(path: Path, connection: sqlite3.Connection) -> None:
    """Raise `TacpipeError` where what holds topics or messages is no table: a view or a module runs queries of the file."""
    definitions = dict(connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name in ("topics", "messages"):
        if not str(definitions.get(name, "")).upper().startswith("CREATE TABLE"):
            raise TacpipeError(
                f"{path} has no table {name}, which a bag of ROS 2 has; a view of this name is not read."
            )


def _read_channels(connection: sqlite3.Connection) -> Iterator[Record]:
    definitions: dict[str, tuple[str, bytes]] = {}
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {str(name): (str(kind), str(text).encode()) for name, kind, text in connection.execute(query)}
    for number, topic, name, encoding in connection.execute("SELECT id, name, type, serialization_format FROM topics"):
        kind, text = definitions.get(str(name), ("ros2msg", b""))
        yield Channel(number, str(topic), ros.normalize_type_name(str(name)), str(encoding), kind, text)
    if "schema" in tables:
        for (distribution,) in connection.execute("SELECT ros_distro FROM schema"):
            yield Metadata("rosbag2", {"ros_distro": str(distribution or "")})
