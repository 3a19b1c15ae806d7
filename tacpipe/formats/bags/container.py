"""Read a bag as a container of streams: one pass over the records of its files, decoded topic by topic.

A bag that `tacpipe export mcap` wrote is restored exactly. The metadata of a stream's channel contain the names of the
stream and its columns (key ``tacpipe``, JSON). Topics that repeat columns as standard messages name the topic that they
are derived from. The metadata record ``tacpipe`` contains the attributes.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict, cast

import pyarrow as pa

from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.bags import mcap_file, ros, ros_files
from tacpipe.formats.bags.headers import APART_NS, MIN_BLOCKS, USE_LOG
from tacpipe.formats.bags.images import declare_images
from tacpipe.formats.bags.ros_files import BagDamage, BagMessage, Metadata, Record, TopicConnection
from tacpipe.formats.bags.topics import HEADER, LOG, Json, MessageDecoder, Protobuf, TopicDecoder, TopicError
from tacpipe.formats.container import Batched, Container, EpisodeContents, SourceStream, Time
from tacpipe.formats.faults import explaining
from tacpipe.io import config_text, regular
from tacpipe.io import files as file_system
from tacpipe.io.config_text import plain_value
from tacpipe.io.spill import Spill, unpack
from tacpipe.plugins import extras
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, listed, plain

EXPORT_KEY = "tacpipe"  # key in a channel's metadata, and name of the metadata record


@dataclass(frozen=True)
class ExportedStream:
    """A stream as it was before it was exported."""

    stream: str
    derived: bool  # True if the topic only repeats another one
    columns: Mapping[str, tuple[str, Mapping[str, str]]]  # column name and metadata by field of the message
    time: Mapping[str, str]  # metadata of the column ``t_ns``


def exported_stream(metadata: Mapping[str, str]) -> ExportedStream | None:
    """Return the stream that a channel's metadata describe, or None if tacpipe did not write them."""
    description = container.json_object(metadata.get(EXPORT_KEY, ""))
    if "derived_from" in description:
        return ExportedStream("", True, {}, {})
    try:
        columns = {
            str(column["field"]): (str(column["name"]), _texts(column["about"])) for column in description["columns"]
        }
        return ExportedStream(str(description["stream"]), False, columns, _texts(description.get("time", {})))
    except (KeyError, TypeError, AttributeError):
        return None


def restore_stream(stream: SourceStream, exported: ExportedStream) -> SourceStream:
    """Return a stream with its original column names and metadata."""
    fields: dict[str, pa.Field] = {}  # restored fields by column name in the bag
    for column in stream.schema:
        if column.name in exported.columns:
            name, metadata = exported.columns[column.name]
            fields[column.name] = pa.field(name, column.type, metadata=dict(metadata))
        elif column.name == stream.time.column:
            fields[column.name] = pa.field(HEADER, column.type, metadata=dict(exported.time))
        elif column.name not in (
            LOG,
            HEADER,
        ):  # exported log times equal the header stamps; a stamp of 0 counts as unset
            fields[column.name] = column
    assert isinstance(stream.content, Batched)
    content = stream.content.with_fields(fields)
    return SourceStream(stream.source, stream.name, Time(HEADER, "ns"), content, stream.rows)


def _texts(values: Mapping[str, Attribute]) -> dict[str, str]:
    return {str(key): str(value) for key, value in values.items()}


SPLIT_NS = 10**9  # maximum time between two files of one recording
LOOK_MESSAGES = 20_000  # maximum number of messages read per file by `Bag.look`
MAX_DESCRIPTION_BYTES = 1 << 22  # maximum size of metadata.yaml
READERS = {".mcap": mcap_file.read_records, ".db3": ros_files.read_sqlite_records, ".bag": ros_files.read_bag_records}
UNPACKED_BYTES = 1 << 20  # number of bytes decompressed at once
ZSTD = ".zstd"  # suffix of a file that is compressed as a whole
ACTIVE = ".active"  # suffix of a ROS 1 bag that is being written, or whose recorder was killed
SUFFIX_MARK = ":"  # separates a topic from a stream suffix, as in "/tf:gripper"
ROS2_METADATA = "rosbag2"  # name of the metadata record that ROS 2 writes


@dataclass(frozen=True)
class Bag(Container):
    """A bag, which is one recording: one file, or a ROS 2 folder with ``metadata.yaml``."""

    path: Path

    def look(self, episode: str | None) -> EpisodeContents:
        """Return the streams in the first `LOOK_MESSAGES` messages of each file."""
        return self._read(None, LOOK_MESSAGES)

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        """Return the streams of the topics in ``sources``, or of all topics if it is None."""
        return self._read(sources, None)

    def _read(self, sources: Collection[str] | None, max_messages: int | None) -> EpisodeContents:
        """Return the contents of the bag, of all or only the requested ``sources``, up to ``max_messages`` per file."""
        with contextlib.ExitStack() as stack:
            files, messages_compressed, notes = _bag_files(self.path, stack)
            reading = _BagReading(self.path, sources, messages_compressed)
            for number, file in enumerate(files):
                reading.add_records(_read_records(file), number, max_messages)
        contents = reading.contents()
        if max_messages is None and not self.path.is_dir():
            notes += _describe_next_part(self.path, reading.last_ns)
        return EpisodeContents(contents.streams, contents.attributes, contents.skipped, [*notes, *contents.notes])


def open_bag(path: Path) -> Bag:
    """Return the bag at ``path``. Raises `MissingModuleError` if a library is missing."""
    extras.require("Reading bags and MCAP files", "rosbags", "mcap", "lz4", "zstandard", "google.protobuf")
    return Bag(path)


def _bag_files(path: Path, stack: contextlib.ExitStack) -> tuple[list[Path], bool, list[str]]:
    """Return the files of a bag in order, whether each message is compressed, and notes about the files.

    Temporary files of compressed bags exist until ``stack`` is closed. Raises `TacpipeError` if the bag has no files, or
    files of an unsupported storage.
    """
    if not path.is_dir():
        return [_unpack_file(path, stack)], False, []
    description = _read_description(path / "metadata.yaml")
    listing = description.get("relative_file_paths")
    names = [Path(str(name)).name for name in listing] if isinstance(listing, list) else []
    container.parts_by_name(((name, name) for name in names), path / "metadata.yaml", "file")
    missing = [name for name in names if not (path / name).is_file()]
    notes = [f"{path} lacks {listed(missing, 3)}, which its metadata.yaml names."] if missing else []
    bag_files = sorted(file for file in file_system.listed(path) if _file_ending(file) in READERS)
    # metadata.yaml may list names from before a rename
    present_files = [regular.inside(path, name) for name in names if name not in missing] or bag_files
    if unlisted := [file.name for file in bag_files if file not in present_files]:
        notes.append(
            f"{path} holds {listed(unlisted, 3)}, which its metadata.yaml does not name and which are not read."
        )
    if not present_files:
        raise TacpipeError(f"{path} holds no file of a bag; its metadata.yaml names {listed(names, 3) or 'none'}.")
    if unsupported := [file.name for file in present_files if _file_ending(file) not in READERS]:
        storage = excerpt(description.get("storage_identifier"))
        raise TacpipeError(f"{path}: {plain(unsupported[0])} is of the storage {storage}; mcap and sqlite3 are read.")
    compressed = str(description.get("compression_mode") or "").lower() == "message"
    return [_unpack_file(file, stack) for file in present_files], compressed, notes


def _describe_next_part(path: Path, last_ns: int) -> list[str]:
    """Return a note if the file with the next number begins where this one ends, at the log time ``last_ns``."""
    name = re.fullmatch(r"(.*_)(\d+)([.].+)", path.name)
    following = path.with_name(f"{name[1]}{int(name[2]) + 1}{name[3]}") if name else path
    if name is None or not following.is_file():
        return []
    with contextlib.ExitStack() as stack, contextlib.suppress(TacpipeError):
        records = _read_records(_unpack_file(following, stack))
        start_ns = next((record.log_ns for record in records if isinstance(record, BagMessage)), 0)
        if 0 <= start_ns - last_ns < SPLIT_NS:
            join = "rosbags-convert" if _file_ending(path) == ".bag" else "ros2 bag reindex"
            return [
                f"The files {name[1]}*{name[3]} in {path.parent} continue one another and are read as separate "
                f"recordings. If they are parts of one, join them with `{join}`, and ingest again."
            ]
    return []


def _read_records(path: Path) -> Iterator[Record]:
    if _file_ending(path) not in READERS:
        raise TacpipeError(f"{path} is not a bag by its name; {', '.join(READERS)} are read.")
    return _read_compressed(path) if path.suffix.lower() == ZSTD else READERS[_file_ending(path)](path)


def _read_compressed(path: Path) -> Iterator[Record]:
    """Yield the records of a compressed MCAP file."""
    import zstandard

    with (
        regular.failing(path),
        regular.opened(path) as file,
        zstandard.ZstdDecompressor().stream_reader(file) as content,
    ):
        try:
            yield from mcap_file.read_stream(path, content)
        except zstandard.ZstdError as error:
            yield BagDamage(f"{path} cannot be unpacked ({plain(str(error), 80)}): what came after is missing.")


def _file_ending(path: Path) -> str:
    """Return a file's suffix in lower case, ignoring a trailing .zstd or .active."""
    return (path.with_suffix("") if path.suffix.lower() in (ZSTD, ACTIVE) else path).suffix.lower()


class BagDescription(TypedDict, total=False):
    """The entries of a bag's ``metadata.yaml`` that are read."""

    relative_file_paths: list[str]


def _read_description(path: Path) -> BagDescription:
    """Return the description of a bag in its ``metadata.yaml``. Raises `TacpipeError` if it has none."""
    advice = ". Without it the files next to it are read one by one."
    with explaining((ValueError, KeyError, TypeError, RecursionError), f"{path} does not describe a bag: ", advice):
        content = regular.content(regular.inside(path.parent, path.name), MAX_DESCRIPTION_BYTES)
        return cast("BagDescription", dict(config_text.load_yaml(content.decode())["rosbag2_bagfile_information"]))


def _unpack_file(path: Path, stack: contextlib.ExitStack) -> Path:
    """Return ``path``, or the path of a temporary unpacked copy if it is a compressed database.

    Raises `TacpipeError` if it cannot be unpacked.
    """
    if path.suffix.lower() != ZSTD or _file_ending(path) == ".mcap":
        return path
    import zstandard

    folder = stack.enter_context(tempfile.TemporaryDirectory())
    unpacked_path = Path(folder, path.stem)
    damaged = explaining(zstandard.ZstdError, f"{path} cannot be unpacked: ")
    with (
        regular.failing(path),
        regular.opened(path) as file,
        unpacked_path.open("wb") as out,
        damaged,
        zstandard.ZstdDecompressor().stream_reader(file) as content,
    ):
        unpack(iter(lambda: content.read(UNPACKED_BYTES), b""), out, path)
    return unpacked_path


@dataclass
class _BagReading:
    """Collects the topics and attributes of a bag from its records."""

    path: Path
    sources: Collection[str] | None
    compressed: bool
    ended_early: bool = False
    topics: dict[str, TopicDecoder] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)  # message type by topic
    skipped: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, Attribute] = field(default_factory=dict)
    exported: dict[str, ExportedStream] = field(default_factory=dict)  # exported streams by topic
    notes: list[str] = field(default_factory=list)
    spill: Spill = field(default_factory=Spill)  # decoded messages
    undescribed: int = 0  # number of messages in channels without a description
    last_ns: int = 0  # last log time of a message
    # channel by file number and channel number
    _described: dict[tuple[int, int], TopicConnection] = field(default_factory=dict)
    _channels: dict[tuple[int, int], str] = field(default_factory=dict)  # topic by file number and channel number

    def add_records(self, records: Iterator[Record], file: int, max_messages: int | None) -> None:
        """Add the records of one file, up to ``max_messages`` messages."""
        for record in records:
            if isinstance(record, BagMessage):
                self._add_message(record, file)
                if max_messages is not None and (max_messages := max_messages - 1) <= 0:
                    self.ended_early = True
                    return
            elif isinstance(record, TopicConnection):
                self._add_channel(record, file)
            elif isinstance(record, Metadata):
                self._add_metadata(record)
            elif isinstance(record, BagDamage):
                self.notes.append(record.text)

    def _add_channel(self, channel: TopicConnection, file: int) -> None:
        """Add a channel and its decoder, unless it is not requested or cannot be decoded.

        Raises `TacpipeError` if the file describes the channel in two ways.
        """
        topic = channel.topic
        before = self._described.setdefault((file, channel.number), channel)
        if before is not channel:  # chunks repeat channel descriptions
            if before != channel:
                raise TacpipeError(
                    f"{self.path} describes the channel {channel.number} twice, as {plain(before.topic)} and as "
                    f"{plain(topic)}, so its messages cannot be assigned. Record it again, or repair it with `mcap recover`."
                )
            return
        if (exported := exported_stream(channel.metadata)) is not None:
            if exported.derived:
                return
            self.exported[topic] = exported
        if self.sources is not None and all(source.split(SUFFIX_MARK)[0] != topic for source in self.sources):
            return
        self._channels[file, channel.number] = topic
        if topic in self.skipped:
            return
        if topic in self.topics:
            if self.types[topic] != channel.type:
                self._skip(topic, f"it has messages of two types, {plain(self.types[topic])} and {plain(channel.type)}")
            return
        try:
            self.topics[topic] = TopicDecoder(_decoder_for_channel(channel), self.spill)
            self.types[topic] = channel.type
        except TopicError as error:
            self._skip(topic, str(error))

    def _add_message(self, message: BagMessage, file: int) -> None:
        """Pass a message to the decoder of its topic; a topic with a message that cannot be decoded is skipped."""
        topic = self.topics.get(self._channels.get((file, message.channel), ""))
        if topic is None:
            self.undescribed += (file, message.channel) not in self._described
            return
        try:
            content = _decompress_message(message.content) if self.compressed else message.content
            topic.add(content, message.log_ns, message.publish_ns)
        except TopicError as error:
            self._skip(self._channels[file, message.channel], str(error))

    def _add_metadata(self, metadata: Metadata) -> None:
        """Add the attributes in a metadata record: of ROS 2, of an export of tacpipe, or of another program."""
        if metadata.name == ROS2_METADATA:
            if metadata.values.get("ros_distro"):
                self.attributes["ros_distro"] = metadata.values["ros_distro"]
            return
        if metadata.name == EXPORT_KEY:
            self.attributes |= container.plain_values(container.json_object(metadata.values.get("attributes", "")))
            return

        for name, value in metadata.values.items():
            self.attributes.setdefault(plain(name), plain_value(value))

    def _skip(self, topic: str, reason: str) -> None:
        self.skipped[topic] = reason
        self.topics.pop(topic, None)

    def contents(self) -> EpisodeContents:
        """Return the streams, attributes, skipped topics and notes."""
        streams_with_origin: list[tuple[ExportedStream | None, SourceStream]] = []
        delays_s: dict[str, float] = {}  # delay of the times behind the log times by source
        for topic, reading in list(self.topics.items()):
            if not reading.count:
                continue
            try:
                topic_streams = reading.finish()
            except TopicError as error:
                self._skip(topic, str(error))
                continue
            if not topic_streams:
                self.skipped[topic] = f"its messages ({plain(self.types[topic])}) hold no values"
            for topic_stream in topic_streams:
                source = f"{topic}{SUFFIX_MARK}{topic_stream.suffix}" if topic_stream.suffix else topic
                if self.sources is not None and source not in self.sources:
                    continue
                rows = None if self.ended_early else topic_stream.content.rows
                exported = self.exported.get(topic)
                name = exported.stream if exported is not None and exported.stream else source
                content = topic_stream.content
                if exported is None:
                    content = declare_images(content, self.types[topic])
                arrivals = LOG if HEADER in content.schema.names else ""  # topics without header stamps have one time
                stream = SourceStream(source, name, topic_stream.time, content, rows, arrivals)
                streams_with_origin.append((exported, stream))
                if topic_stream.content.rows >= MIN_BLOCKS:
                    delays_s[source] = topic_stream.delay_ns / 1e9
                self.last_ns = max(self.last_ns, topic_stream.log_span_ns[1])
                self.notes += [f"{plain(source)}: {note}." for note in topic_stream.notes]
        self.notes += self._describe_delays(delays_s)
        if self.undescribed:
            self.notes.append(f"{self.path} has {self.undescribed:,} messages of channels that it does not describe.")
        if self.ended_early:
            self.notes.append(
                f"The first {LOOK_MESSAGES} messages of each file were looked at; later ones may have other topics."
            )
        if not streams_with_origin and not self.skipped:
            self.skipped = dict.fromkeys(self.topics, "it has no messages")
        streams = [
            stream if exported is None else restore_stream(stream, exported) for exported, stream in streams_with_origin
        ]
        name_counts = Counter(stream.name for stream in streams)
        streams = [
            stream if name_counts[stream.name] == 1 else replace(stream, name=stream.source) for stream in streams
        ]
        names = container.identifiers([stream.name for stream in streams])
        streams = [replace(stream, name=names[stream.name]) for stream in streams]
        return EpisodeContents(streams, self.attributes, self.skipped, self.notes)

    def _describe_delays(self, delays_s: Mapping[str, float]) -> list[str]:
        """Return a note if header stamps of some streams are further behind the log times than those of others."""
        if not delays_s or max(delays_s.values()) - min(delays_s.values()) <= APART_NS / 1e9:
            return []
        ordered = sorted(delays_s, key=lambda source: -delays_s[source])
        delays = listed([f"{plain(source)} {delays_s[source]:.3f} s" for source in ordered], 6)
        return [
            f"{self.path}: header stamps are behind the log times by different amounts: {delays}. If these are the clocks "
            f"of two computers, {USE_LOG} of all streams, and offset_s in its place shifts one."
        ]


def _decompress_message(content: bytes) -> bytes:
    """Return the content of a compressed message. Raises `TopicError` if it is damaged."""
    import zstandard

    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(content)
    except zstandard.ZstdError as error:
        raise TopicError("a compressed message is damaged") from error


def _decoder_for_channel(channel: TopicConnection) -> MessageDecoder:
    """Return the decoder for the messages of a channel. Raises `TopicError` for an unsupported encoding."""
    text = channel.schema.decode(errors="replace")
    if channel.encoding in ("ros1", "cdr"):
        kind: ros.Definition = "idl" if channel.schema_encoding == "ros2idl" else "msg"
        name = ros.normalize_type_name(channel.type)
        return ros.RosDecoder(name, ros.parse_definitions(name, kind, text), channel.encoding == "cdr")
    if channel.encoding == "json":
        return Json(text)
    if channel.encoding == "protobuf":
        return Protobuf(channel.type, channel.schema)
    raise TopicError(
        f"its messages are written as {plain(channel.encoding) or 'nothing known'}, not ros1, cdr, json or protobuf"
    )
